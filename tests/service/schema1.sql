BEGIN TRANSACTION;
CREATE TABLE asset (
	job_id VARCHAR NOT NULL, 
	name VARCHAR NOT NULL, 
	size INTEGER NOT NULL, 
	sha256 VARCHAR NOT NULL, 
	media_type VARCHAR NOT NULL, 
	PRIMARY KEY (job_id, name)
);
INSERT INTO "asset" VALUES('4f84f19f-5047-474b-b70d-c4002dffa5c1','metrics.json',3,'ca3d163bab055381827226140568f3bef7eaac187cebd76878e0b63e9e442356','application/json');
INSERT INTO "asset" VALUES('4f84f19f-5047-474b-b70d-c4002dffa5c1','trajectory.tum',5,'bb3bf29c29d099503eba622ca7c090b8d1b77d3f785141830ba9c199c8086e5b','text/plain; charset=utf-8');
CREATE TABLE delivery (
	id VARCHAR NOT NULL, 
	tenant VARCHAR NOT NULL, 
	job_id VARCHAR NOT NULL, 
	url VARCHAR NOT NULL, 
	body TEXT NOT NULL, 
	state VARCHAR NOT NULL, 
	attempts INTEGER NOT NULL, 
	next_at DOUBLE NOT NULL, 
	last_status INTEGER, 
	last_error VARCHAR, 
	created DOUBLE NOT NULL, 
	PRIMARY KEY (id)
);
INSERT INTO "delivery" VALUES('1d8b962e-d0c6-4f37-8c60-86fe1a440631','one','4f84f19f-5047-474b-b70d-c4002dffa5c1','http://127.0.0.1:9/x','{"event":"job.ended","event_id":"1d8b962e-d0c6-4f37-8c60-86fe1a440631","job":"4f84f19f-5047-474b-b70d-c4002dffa5c1","state":"succeeded","reason":null,"message":null,"log":"office.mcap","ended":1795689955.359389}','pending',1,1.79568995749904155734e+09,NULL,'ForbiddenAddress: 127.0.0.1 leads to 127.0.0.1, which is not a public address',1.79568995535938906666e+09);
CREATE TABLE event (
	id INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT, 
	tenant VARCHAR NOT NULL, 
	job_id VARCHAR NOT NULL, 
	at DOUBLE NOT NULL, 
	kind VARCHAR NOT NULL, 
	data JSON NOT NULL
);
INSERT INTO "event" VALUES(1,'one','4f84f19f-5047-474b-b70d-c4002dffa5c1',1.79568995515988683703e+09,'state','{"state": "queued"}');
INSERT INTO "event" VALUES(2,'one','4f84f19f-5047-474b-b70d-c4002dffa5c1',1.79568995516767239569e+09,'state','{"state": "running", "attempt": 1}');
INSERT INTO "event" VALUES(3,'one','4f84f19f-5047-474b-b70d-c4002dffa5c1',1.79568995535940265657e+09,'state','{"state": "succeeded", "reason": null, "message": null}');
INSERT INTO "event" VALUES(4,'one','3205ac20-a13a-4d97-a473-8c533be90110',1.79568995543918561936e+09,'state','{"state": "queued"}');
INSERT INTO "event" VALUES(5,'one','3205ac20-a13a-4d97-a473-8c533be90110',1.79568995544389390945e+09,'state','{"state": "running", "attempt": 1}');
INSERT INTO "event" VALUES(6,'one','3205ac20-a13a-4d97-a473-8c533be90110',1.79568995571259593961e+09,'state','{"state": "failed", "reason": "invalid_input", "message": "run.mcap: no scan"}');
INSERT INTO "event" VALUES(7,'one','d826de3c-f11b-4b18-83f5-086de374f754',1.79568995578113365175e+09,'state','{"state": "queued"}');
INSERT INTO "event" VALUES(8,'one','d826de3c-f11b-4b18-83f5-086de374f754',1.79568995578802180295e+09,'state','{"state": "running", "attempt": 1}');
INSERT INTO "event" VALUES(9,'one','d826de3c-f11b-4b18-83f5-086de374f754',1.79568995583886384967e+09,'state','{"state": "cancelling"}');
INSERT INTO "event" VALUES(10,'one','d826de3c-f11b-4b18-83f5-086de374f754',1.79568995596088075636e+09,'state','{"state": "cancelled", "reason": "cancelled", "message": "cancelled"}');
INSERT INTO "event" VALUES(11,'one','19135a1f-f827-49d2-8d2f-f7bc60789f8e',1.79568995603462314603e+09,'state','{"state": "queued"}');
INSERT INTO "event" VALUES(12,'one','19135a1f-f827-49d2-8d2f-f7bc60789f8e',1.7956899560506691932e+09,'state','{"state": "running", "attempt": 1}');
INSERT INTO "event" VALUES(13,'one','d54c5710-86d2-4cac-b0bb-de504833e55d',1.79568995609402537339e+09,'state','{"state": "queued"}');
CREATE TABLE file (
	id VARCHAR NOT NULL, 
	tenant VARCHAR NOT NULL, 
	name VARCHAR NOT NULL, 
	state VARCHAR NOT NULL, 
	size INTEGER, 
	received INTEGER NOT NULL, 
	sha256 VARCHAR, 
	created DOUBLE NOT NULL, 
	expires DOUBLE, 
	PRIMARY KEY (id)
);
INSERT INTO "file" VALUES('0194ee9e-2480-435d-9cbc-0f3624a2a66e','one','office.mcap','complete',2,2,'2689367b205c16ce32ed4200942b8b8b1e262dfc70d9bc9fbc77c49699a4f1df',1.79568995504902195929e+09,NULL);
INSERT INTO "file" VALUES('b0ca6589-3524-4ecb-b6d8-db8ae2800276','one','run.mcap','complete',9,9,'541cb554dd4100b7282a0a7e22c92033bc625e9595bea40a84193d89fca670ca',1.79568995541090083122e+09,NULL);
INSERT INTO "file" VALUES('eb19f706-02bf-4515-b79a-9381c6f1d5b6','one','run.mcap','complete',7,7,'afbad2757b2ef8feb8721cbc6647ccf57f9a87e7bd6bb489860cb4bdc22458d2',1.79568995575881242745e+09,NULL);
INSERT INTO "file" VALUES('0715eec5-3fc9-4fbc-b7fb-a9d24024ae76','one','log','receiving',9,0,NULL,1.79568995599065399162e+09,1.79577635599065399169e+09);
INSERT INTO "file" VALUES('cb5e2da5-b42f-4b62-b4e6-2ed156187b8b','one','run.mcap','complete',8,8,'61a6a3c8eb9547ed28e70f21390647864e7e8989604aeb0a2627dada127a8e58',1.79568995600504088404e+09,NULL);
CREATE TABLE idempotency (
	tenant VARCHAR NOT NULL, 
	"key" VARCHAR NOT NULL, 
	sha256 VARCHAR NOT NULL, 
	job_id VARCHAR NOT NULL, 
	created DOUBLE NOT NULL, 
	PRIMARY KEY (tenant, "key")
);
INSERT INTO "idempotency" VALUES('one','office-1','28611292d8ce512e0419224bc964b91c6b49f383fca8d0dc8179cf3f23f9b980','4f84f19f-5047-474b-b70d-c4002dffa5c1',1.79568995515995240208e+09);
CREATE TABLE job (
	seq INTEGER NOT NULL, 
	id VARCHAR NOT NULL, 
	tenant VARCHAR NOT NULL, 
	file_id VARCHAR NOT NULL, 
	log_name VARCHAR NOT NULL, 
	request JSON NOT NULL, 
	rerun_of VARCHAR, 
	state VARCHAR NOT NULL, 
	reason VARCHAR, 
	message VARCHAR, 
	created DOUBLE NOT NULL, 
	started DOUBLE, 
	ended DOUBLE, 
	attempt INTEGER NOT NULL, 
	owner VARCHAR, 
	lease_until DOUBLE, 
	cancel BOOLEAN NOT NULL, 
	phase VARCHAR, 
	done DOUBLE, 
	total DOUBLE, 
	scans INTEGER, 
	speed DOUBLE, 
	progressed DOUBLE, 
	heartbeat DOUBLE, 
	folder VARCHAR, 
	summary JSON, 
	webhook VARCHAR, 
	PRIMARY KEY (seq), 
	UNIQUE (id)
);
INSERT INTO "job" VALUES(1,'4f84f19f-5047-474b-b70d-c4002dffa5c1','one','0194ee9e-2480-435d-9cbc-0f3624a2a66e','office.mcap','{"log": "0194ee9e-2480-435d-9cbc-0f3624a2a66e", "map": null, "mode": "auto", "matcher": null, "mapper": null, "preset": "default", "seed": 7, "initial_pose": null, "unknown_start": false, "no_odometry": false, "alignment": null, "read": null, "config": null, "webhook": "http://127.0.0.1:9/x"}',NULL,'succeeded',NULL,NULL,1.79568995515792179107e+09,1.79568995516762542731e+09,1.79568995535938906666e+09,1,NULL,NULL,0,NULL,NULL,NULL,NULL,NULL,NULL,1.79568995529829502104e+09,'4f84f19f-5047-474b-b70d-c4002dffa5c1.1','{"metrics": {}, "data_lost": false, "warnings": [], "notes": [], "timings": {}}','http://127.0.0.1:9/x');
INSERT INTO "job" VALUES(2,'3205ac20-a13a-4d97-a473-8c533be90110','one','b0ca6589-3524-4ecb-b6d8-db8ae2800276','run.mcap','{"log": "b0ca6589-3524-4ecb-b6d8-db8ae2800276", "map": null, "mode": "auto", "matcher": null, "mapper": null, "preset": "default", "seed": 0, "initial_pose": null, "unknown_start": false, "no_odometry": false, "alignment": null, "read": null, "config": null, "webhook": null}',NULL,'failed','invalid_input','run.mcap: no scan',1.79568995543844580654e+09,1.79568995544381141663e+09,1.79568995571258306501e+09,1,NULL,NULL,0,NULL,NULL,NULL,NULL,NULL,NULL,1.79568995556197309499e+09,NULL,NULL,NULL);
INSERT INTO "job" VALUES(3,'d826de3c-f11b-4b18-83f5-086de374f754','one','eb19f706-02bf-4515-b79a-9381c6f1d5b6','run.mcap','{"log": "eb19f706-02bf-4515-b79a-9381c6f1d5b6", "map": null, "mode": "auto", "matcher": null, "mapper": null, "preset": "default", "seed": 0, "initial_pose": null, "unknown_start": false, "no_odometry": false, "alignment": null, "read": null, "config": null, "webhook": null}',NULL,'cancelled','cancelled','cancelled',1.79568995578046798709e+09,1.79568995578797483444e+09,1.79568995596087121959e+09,1,NULL,NULL,1,NULL,NULL,NULL,NULL,NULL,NULL,1.79568995591422843937e+09,NULL,NULL,NULL);
INSERT INTO "job" VALUES(4,'19135a1f-f827-49d2-8d2f-f7bc60789f8e','one','cb5e2da5-b42f-4b62-b4e6-2ed156187b8b','run.mcap','{"log": "cb5e2da5-b42f-4b62-b4e6-2ed156187b8b", "map": null, "mode": "auto", "matcher": null, "mapper": null, "preset": "default", "seed": 0, "initial_pose": null, "unknown_start": false, "no_odometry": false, "alignment": null, "read": null, "config": null, "webhook": null}',NULL,'running',NULL,NULL,1.79568995603418207164e+09,1.79568995605063700671e+09,NULL,1,'8c184783c16a46d39d9920fe464b12a2',1.79568996105063700681e+09,0,NULL,NULL,NULL,NULL,NULL,NULL,1.79568995605063700671e+09,NULL,NULL,NULL);
INSERT INTO "job" VALUES(5,'d54c5710-86d2-4cac-b0bb-de504833e55d','one','0194ee9e-2480-435d-9cbc-0f3624a2a66e','office.mcap','{"log": "0194ee9e-2480-435d-9cbc-0f3624a2a66e", "map": null, "mode": "auto", "matcher": null, "mapper": null, "preset": "default", "seed": 8, "initial_pose": null, "unknown_start": false, "no_odometry": false, "alignment": null, "read": null, "config": null, "webhook": null}',NULL,'queued',NULL,NULL,1.79568995609355807306e+09,NULL,NULL,0,NULL,NULL,0,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL);
CREATE TABLE secret (
	tenant VARCHAR NOT NULL, 
	webhook VARCHAR NOT NULL, 
	PRIMARY KEY (tenant), 
	UNIQUE (tenant)
);
INSERT INTO "secret" VALUES('one','YVaFQ964yqZCh3grYLup5oj-r4G-wup5tF4SjYjHN8o');
CREATE TABLE token (
	id VARCHAR NOT NULL, 
	tenant VARCHAR NOT NULL, 
	label VARCHAR NOT NULL, 
	scopes VARCHAR NOT NULL, 
	sha256 VARCHAR NOT NULL, 
	created DOUBLE NOT NULL, 
	expires DOUBLE, 
	revoked DOUBLE, 
	PRIMARY KEY (id)
);
INSERT INTO "token" VALUES('97b62d65','one','','read write admin','73290e5e3c98c9245c40a5fda155ccdfde64c30163b0ce9bea320f67c1da2009',1.79568995499643254279e+09,NULL,NULL);
CREATE INDEX ix_file_tenant ON file (tenant);
CREATE INDEX ix_job_file_id ON job (file_id);
CREATE INDEX job_by_state ON job (state, seq);
CREATE INDEX ix_job_tenant ON job (tenant);
CREATE INDEX event_by_job ON event (job_id, id);
CREATE INDEX ix_delivery_job_id ON delivery (job_id);
DELETE FROM "sqlite_sequence";
INSERT INTO "sqlite_sequence" VALUES('event',13);
COMMIT;
PRAGMA user_version=1;
