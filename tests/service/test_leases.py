"""Leases and fences, on the database alone."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest
from live_service import go_on, settings, submit, wait
from sqlalchemy import text, update
from waiting import LIMIT_S, until

from hsloc_service.auth import ANYBODY, Principal
from hsloc_service.db.database import open_database
from hsloc_service.db.tables import JobRow
from hsloc_service.errors import ServiceError
from hsloc_service.execution.job_process import parse_line
from hsloc_service.jobs.leases import Leases, RetryPolicy, place_in_queue
from hsloc_service.jobs.repository import ORDERS, JobFilter, Jobs
from hsloc_service.jobs.workers import Presence
from hsloc_service.results.store import Asset
from hsloc_service.storage import Storage
from hsloc_service.uploads.repository import Files

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from fastapi.testclient import TestClient
    from postgresql import Server
    from sqlalchemy.orm import Session

OTHER = Principal("other", ANYBODY.scopes)


class Parts:
    def __init__(self, folder: Path, database_url: str = "") -> None:
        chosen = settings(folder, database_url=database_url)
        chosen.data.mkdir()
        self.database = open_database(chosen)
        self.storage = Storage(chosen.data)
        self.files = Files(self.database, self.storage, chosen)
        self.jobs = Jobs(self.database, self.storage, chosen)

    def leases(self, lease_s: float = 30.0, max_attempts: int = 3) -> Leases:
        return Leases(self.database, lease_s, RetryPolicy(max_attempts))

    def submit(self, who: Principal = ANYBODY, **options: Any) -> str:
        file = self.files.create(who, "run.mcap", 1)
        self.files.complete(file.id, 1, "00")
        return self.jobs.submit(who, {"log": file.id, "map": None, **options}).job.id


@pytest.fixture
def parts(tmp_path: Path, database_url: str) -> Iterator[Parts]:
    made = Parts(tmp_path, database_url)
    yield made
    made.database.close()
    made.storage.close()


ASSET = [Asset("a", 1, "00", "text/plain")]


def test_a_job_is_claimed_once(parts: Parts) -> None:
    job = parts.submit()
    leases = parts.leases()
    claim = leases.claim("a")
    assert claim is not None
    assert (claim.job_id, claim.attempt) == (job, 1)
    assert leases.claim("b") is None


def test_the_place_in_the_queue_is_that_of_the_claims(parts: Parts) -> None:
    jobs = [parts.submit(priority=priority) for priority in (0, 0, 5, 0, 5)]
    parts.submit(OTHER)
    leases = parts.leases()

    def places() -> list[tuple[int, float | None]]:
        found = [parts.jobs.get(ANYBODY, each) for each in jobs]
        return [place_in_queue(parts.database, each) for each in found if each.state == "queued"]

    assert places() == [(2, None), (3, None), (0, None), (4, None), (1, None)]
    claims = {claim.tenant: claim for claim in (leases.claim("a"), leases.claim("a")) if claim is not None}
    mine = claims[ANYBODY.tenant]  # one of each tenant
    assert mine.job_id == jobs[2]
    assert places() == [(1, None), (2, None), (3, None), (0, None)]
    leases.succeed(mine, "f", ASSET, {})
    with parts.database.write() as session:
        session.execute(update(JobRow).where(JobRow.id == mine.job_id).values(started=100.0, ended=108.0))
    assert places() == [(1, 8.0), (2, 16.0), (3, 24.0), (0, 0.0)]
    claim = leases.claim("a")
    assert claim is not None
    assert claim.job_id == jobs[4]
    assert places() == [(0, 4.0), (1, 12.0), (2, 20.0)]


def test_an_expired_lease_is_taken_over_and_the_first_owner_is_fenced_off(parts: Parts) -> None:
    job = parts.submit()
    short, long = parts.leases(lease_s=0.0), parts.leases()
    first = short.claim("a")
    time.sleep(0.01)
    assert long.recover() == [job]
    second = long.claim("b")
    assert first is not None
    assert second is not None
    assert second.attempt == 2
    assert not long.beat(first, None).mine
    assert not long.succeed(first, "first", ASSET, {})
    assert not long.fail(first, "failed", "x", "x")
    long.release(first, "x")
    assert long.beat(second, None).mine
    assert long.succeed(second, "second", ASSET, {})
    assert not long.succeed(second, "third", ASSET, {})
    done = parts.jobs.get(ANYBODY, job)
    assert (done.state, done.folder, done.attempt) == ("succeeded", "second", 2)
    states = [row.data["state"] for row in parts.jobs.events(ANYBODY, job, 0)[1]]
    assert states == ["queued", "running", "queued", "running", "succeeded"]


def test_a_job_that_kills_its_server_is_given_up(parts: Parts) -> None:
    job = parts.submit()
    leases = parts.leases(max_attempts=3)
    for owner in "abc":
        assert leases.claim(f"folder:{owner}") is not None
        leases.recover("folder:the next server")
    found = parts.jobs.get(ANYBODY, job)
    assert (found.state, found.reason) == ("crashed", "attempts")
    assert leases.claim("d") is None


def test_recover_leaves_a_live_lease_alone(parts: Parts) -> None:
    parts.submit()
    leases = parts.leases()
    assert leases.claim("a") is not None
    assert leases.recover() == []
    assert leases.recover("a") == []


def test_cancel_wins_over_success(parts: Parts) -> None:
    job = parts.submit()
    leases = parts.leases()
    claim = leases.claim("a")
    assert claim is not None
    parts.jobs.cancel(ANYBODY, job)
    assert leases.beat(claim, None).cancel
    assert not leases.succeed(claim, "folder", ASSET, {})
    assert leases.fail(claim, "failed", "x", "x")
    assert parts.jobs.get(ANYBODY, job).state == "cancelled"


def test_cancelled_while_its_server_is_killed(parts: Parts) -> None:
    job = parts.submit()
    leases = parts.leases()
    leases.claim("folder:a")
    parts.jobs.cancel(ANYBODY, job)
    leases.recover("folder:b")
    assert parts.jobs.get(ANYBODY, job).state == "cancelled"


def test_a_tenant_with_many_jobs_does_not_hold_up_another(parts: Parts) -> None:
    many = [parts.submit() for _ in range(4)]
    single = parts.submit(OTHER)
    leases = parts.leases()
    order = [claim.job_id for _ in range(3) if (claim := leases.claim("a"))]
    assert order == [many[0], single, many[1]]


def test_tenants_take_turns_in_a_single_slot(parts: Parts) -> None:
    """Where nothing runs between two claims, who was served longest ago comes first."""
    many = [parts.submit() for _ in range(4)]
    others = [parts.submit(OTHER) for _ in range(2)]
    leases = parts.leases()
    order = []
    for _ in range(6):
        claim = leases.claim("a")
        assert claim is not None
        order.append(claim.job_id)
        leases.succeed(claim, f"{claim.job_id}.1", ASSET, {})
    assert order == [many[0], others[0], many[1], others[1], many[2], many[3]]


def test_a_lease_that_a_clock_ended_is_not_taken_from_the_worker_that_runs_the_job(
    make_client: Callable[..., TestClient], tmp_path: Path
) -> None:
    client = make_client(slots=2)
    job = submit(client, b"held")
    wait(client, job, states=("running",))
    database = client.app.state.context.database  # type: ignore[attr-defined]
    for _ in range(10):  # the other slot looks for work all the while
        with database.write() as session:  # what a clock that is set forward does to every lease
            session.execute(update(JobRow).values(lease_until=1.0))
        time.sleep(0.2)
    go_on(tmp_path / "data", job)
    ended = wait(client, job)
    assert (ended["state"], ended["attempt"]) == ("succeeded", 1)


def test_leases_are_measured_by_the_database(parts: Parts, monkeypatch: pytest.MonkeyPatch) -> None:
    job = parts.submit(webhook="http://127.0.0.1:9/")
    claim = parts.leases().claim("a")
    assert claim is not None
    now = time.time()
    monkeypatch.setattr(time, "time", lambda: now + 3600.0)
    assert parts.leases().recover() == []
    assert parts.leases().fail(claim, "failed", "none", "") == "failed"
    if parts.database.shared:  # a server whose clock is right would send the webhook after an hour
        (delivery,) = parts.jobs.deliveries(ANYBODY, job)
        assert delivery.next_at < now + 60.0


def test_a_server_that_starts_leaves_the_jobs_of_another_data_folder_alone(parts: Parts) -> None:
    """On a shared database; one in a data folder is held by one server at a time."""
    job = parts.submit()
    leases = parts.leases()
    assert leases.claim("folder:a") is not None
    assert leases.recover("elsewhere:b") == ([] if parts.database.shared else [job])
    parts.submit()
    assert leases.claim("elsewhere:b") is not None


def test_of_many_claims_at_once_each_gets_a_job_of_its_own(parts: Parts) -> None:
    jobs = {parts.submit() for _ in range(12)}
    leases = parts.leases()
    with ThreadPoolExecutor(6) as pool:
        claims = [claim for claim in pool.map(lambda k: leases.claim(f"folder:{k}"), range(16)) if claim is not None]
    # A row that another one takes at this moment is skipped: a claim may come back with nothing, and is tried again.
    while (claim := leases.claim("folder:again")) is not None:
        claims.append(claim)
    assert sorted(claim.job_id for claim in claims) == sorted(jobs)


def test_of_many_submissions_with_one_key_at_once_one_makes_a_job(parts: Parts) -> None:
    file = parts.files.create(ANYBODY, "run.mcap", 1)
    parts.files.complete(file.id, 1, "00")
    with ThreadPoolExecutor(6) as pool:
        made = list(pool.map(lambda _: parts.jobs.submit(ANYBODY, {"log": file.id, "map": None}, "key"), range(12)))
    assert len({submitted.job.id for submitted in made}) == 1
    assert sum(submitted.created for submitted in made) == 1


def test_of_many_submissions_at_once_no_more_wait_than_allowed(parts: Parts) -> None:
    jobs = replace(parts.jobs, settings=replace(parts.jobs.settings, max_queued=3))
    file = parts.files.create(ANYBODY, "run.mcap", 1)
    parts.files.complete(file.id, 1, "00")

    def submit_one(_: int) -> int | None:
        try:
            return jobs.submit(ANYBODY, {"log": file.id, "map": None}).job.seq
        except ServiceError:
            return None

    with ThreadPoolExecutor(6) as pool:
        made = [seq for seq in pool.map(submit_one, range(10)) if seq is not None]
    assert sorted(made) == [1, 2, 3]


def test_a_success_whose_answer_was_lost_may_be_written_again(parts: Parts) -> None:
    parts.submit()
    leases = parts.leases()
    claim = leases.claim("folder:a")
    assert claim is not None
    assert leases.succeed(claim, f"{claim.job_id}.1", ASSET, {})
    assert leases.succeed(claim, f"{claim.job_id}.1", ASSET, {})
    assert not leases.succeed(claim, f"{claim.job_id}.2", ASSET, {})


def test_a_worker_that_stops_while_the_database_is_away_gives_its_job_back(tmp_path: Path, postgresql: Server) -> None:
    parts = Parts(tmp_path, postgresql.new_database())
    job = parts.submit()
    leases, presence = parts.leases(), Presence(parts.database, "folder:a", "worker", 1, 0.5)
    presence.beat()
    claim = leases.claim("folder:a")
    assert claim is not None
    postgresql.stop("immediate")
    presence.beat()
    with ThreadPoolExecutor(1) as pool:
        released = pool.submit(leases.release, claim, "the server was stopped", counts=False)
        time.sleep(0.3)
        assert not released.done()
        postgresql.start()
        released.result(LIMIT_S)
    assert parts.jobs.get(ANYBODY, job).state == "queued"
    parts.database.close()
    parts.storage.close()


def test_a_job_with_a_tag_waits_for_a_worker_that_has_it(parts: Parts) -> None:
    file = parts.files.create(ANYBODY, "run.mcap", 1)
    parts.files.complete(file.id, 1, "00")
    large = parts.jobs.submit(ANYBODY, {"log": file.id, "map": None, "tag": "big-memory"}).job.id
    small = parts.submit()
    leases = parts.leases()
    tagged = replace(leases, tags=("big-memory",))
    claims = [leases.claim("folder:a"), leases.claim("folder:a"), tagged.claim("folder:b")]
    assert [claim and claim.job_id for claim in claims] == [small, None, large]


def test_a_text_that_postgresql_does_not_take(parts: Parts) -> None:
    file = parts.files.create(ANYBODY, "a\0b.mcap", 1)
    assert parts.files.get(ANYBODY, file.id).name == "ab.mcap"
    assert parse_line(b'{"failed": "a\\u0000b"}') == {"failed": "a\ufffdb"}


def test_lists_in_every_order_and_by_every_filter(parts: Parts) -> None:
    """Summaries are JSON, which each database reads by functions of its own."""
    jobs = [parts.submit() for _ in range(2)]
    leases = parts.leases()
    claim = leases.claim("folder:a")
    assert claim is not None
    assert leases.succeed(claim, f"{jobs[0]}.1", ASSET, {"metrics": {"verdict": "good"}})
    for order in ORDERS:
        assert {job.id for job in parts.jobs.list(ANYBODY, JobFilter(order=order))} == set(jobs)
    assert [job.id for job in parts.jobs.list(ANYBODY, JobFilter(verdict="good"))] == jobs[:1]
    assert parts.jobs.count(ANYBODY, JobFilter(search="RUN")) == 2


def test_a_higher_priority_is_begun_first_but_not_before_another_tenants_turn(parts: Parts) -> None:
    low, high, other = parts.submit(), parts.submit(priority=5), parts.submit(OTHER, priority=-5)
    leases = parts.leases()
    claims = [leases.claim("a") for _ in range(4)]
    assert [claim and claim.job_id for claim in claims] == [high, other, low, None]


def test_a_tenant_runs_no_more_than_its_share(parts: Parts) -> None:
    first, second, third = (parts.submit() for _ in range(3))
    other = parts.submit(OTHER)
    leases = replace(parts.leases(), max_running=2)
    claims = [leases.claim("a") for _ in range(4)]
    assert [claim and claim.job_id for claim in claims] == [first, other, second, None]
    assert claims[0] is not None
    assert leases.fail(claims[0], "failed", "x", "x") == "failed"
    assert (claim := leases.claim("b")) is not None
    assert claim.job_id == third


def test_claims_at_the_same_time_do_not_pass_the_share(parts: Parts) -> None:
    for _ in range(12):
        parts.submit()
    leases = replace(parts.leases(), max_running=3)
    with ThreadPoolExecutor(8) as executor:
        claims = list(executor.map(lambda k: leases.claim(f"w{k}"), range(8)))
    assert sum(claim is not None for claim in claims) == 3


def test_a_claim_that_waits_for_a_tenants_share_holds_no_other(tmp_path: Path, postgresql: Server) -> None:
    """Else two claims that take the tenants in different orders wait for each other."""
    parts = Parts(tmp_path, postgresql.new_database())
    taken = parts.submit()
    other = parts.submit(OTHER)
    parts.submit()
    leases, database = replace(parts.leases(), max_running=1), parts.database

    def wait_for_a_waiting_claim(session: Session) -> None:
        query = text("SELECT count(*) FROM pg_locks WHERE NOT granted")
        until(lambda: session.execute(query).scalar_one(), "a claim waits")

    with ThreadPoolExecutor(1) as executor, database.write() as second:
        database.lock(second, f"running {OTHER.tenant}")
        with database.write() as first:
            database.lock(first, f"running {ANYBODY.tenant}")
            claim = executor.submit(leases.claim, "w")
            wait_for_a_waiting_claim(first)
            first.execute(update(JobRow).where(JobRow.id == taken).values(state="running"))
        wait_for_a_waiting_claim(second)  # for the other tenant now, as the first has its share
        database.lock(second, f"running {ANYBODY.tenant}")
        second.commit()
        found = claim.result()
    assert found is not None
    assert found.job_id == other
    database.close()
    parts.storage.close()


def test_a_reason_is_retried_by_the_policy(parts: Parts) -> None:
    job = parts.submit()
    policy = RetryPolicy(3, {"signal": 3}, wait_s=600.0)
    leases = replace(parts.leases(), retries=policy)
    assert [policy.retried_after_s("signal", k) for k in (1, 2, 3)] == [600.0, 1200.0, None]
    assert policy.retried_after_s("exit", 1) is None
    claim = leases.claim("a")
    assert claim is not None
    assert leases.fail(claim, "crashed", "signal", "ended by SIGSEGV") == "queued"
    assert leases.claim("a") is None
    waiting = parts.jobs.get(ANYBODY, job)
    assert (waiting.state, waiting.attempt) == ("queued", 1)
    with parts.database.write() as session:  # and now as if that time had passed
        session.execute(update(JobRow).values(not_before=JobRow.not_before - 600.0))
    claim = leases.claim("a")
    assert claim is not None
    assert claim.attempt == 2
    assert leases.fail(claim, "failed", "invalid_input", "no scan") == "failed"
    second = parts.submit()
    claim = leases.claim("a")
    assert claim is not None
    parts.jobs.cancel(ANYBODY, second)
    assert leases.fail(claim, "crashed", "signal", "x") == "cancelled"
