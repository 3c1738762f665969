"use strict";
// A result on its map: one file for report.html and the service's page. The value that it draws is made by
// hsloc/report/view.py. Text from the run goes in as text, never as markup. Needs charts.js, layers.js, export.js
// and input.js, and view.css.
(() => {
  const { MARKS, Path, before, make, within } = globalThis.ResultLayers;
  const NEAR_CM = 5, FAR_CM = 15;
  const TILE = 512, REST_MS = 150; // pixels; without a move for so long, the map rests
  const EVERYWHERE = [-Infinity, -Infinity, Infinity, Infinity];
  const KINDS = [["", "any event"], ["warning", "warning"], ["loss", "loss"], ["ambiguous", "several places fit"], ["loop", "loop"], ["rejected", "refused scan"]];

  const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const length = globalThis.lengthText;

  class ResultView {
    // `image` is the map's picture, or null; `root` an element that is filled, as is `charts` with the curves.
    constructor(root, data, image, charts) {
      this.$charts = charts;
      this.root = root; this.data = data; this.image = image;
      this.time = 0; this.fingers = new Map(); this.measure = null; this.picked = this.stated = []; this.playing = null; this.speed = 10; this.shift = [0, 0];
      this.ox = (data.extent[0] + data.extent[2]) / 2;
      this.oy = (data.extent[1] + data.extent[3]) / 2;
      this.local = (x, y) => [x - this.ox, y - this.oy];
      this.unpack();
      this.build();
      this.charts = globalThis.ResultCharts(this.$charts, data, (t) => this.seek(t));
      this.dark = matchMedia("screen and (prefers-color-scheme: dark)"); // paper is white
      this.listening = new AbortController();
      const { signal } = this.listening;
      this.dark.addEventListener("change", () => { this.colours = null; this.charts.draw(); this.drawNow(); }, { signal });
      this.observer = new ResizeObserver(() => this.resize());
      this.observer.observe(this.$frame);
      addEventListener("beforeprint", () => { this.all(); this.drawNow(); }, { signal });
      globalThis.listenToView(this);
      this.resize();
      this.all();
      this.seek(0);
    }

    // A tool by which an arrow is dragged: the event `pose` has [x, y, yaw] in the frame of the map (m, rad).
    offerPose(title) { this.startable = true; this.offer("pose", "⇗", title); }
    setPose(arrow) { this.arrow = arrow; this.drawOver(); }
    // A tool by which two places of the trajectory are clicked: the event `loop` has their times (s).
    offerLoop(title) { this.offer("loop", "∞", title); }
    // Pairs of times [t1, t2, ink] that are drawn as lines between the places of the trajectory then.
    setLoops(loops) { this.stated = loops; this.picked = []; this.drawOver(); }
    offer(name, sign, title) {
      this.$tools.append(make("button", { type: "button", "data-do": name, title, "aria-label": title, "aria-pressed": "false" }, sign));
    }

    // Frees what the page holds beyond the element.
    end() {
      this.stop();
      clearTimeout(this.resting);
      cancelAnimationFrame(this.drawn);
      this.observer.disconnect();
      this.listening.abort();
      this.charts.end();
      this.root.replaceChildren();
    }

    unpack() {
      const scans = this.data.scans;
      if (!scans) return;
      const raw = bytes(scans.points), view = new DataView(raw.buffer);
      this.xy = Float32Array.from({ length: raw.length / 2 }, (_, k) => view.getInt16(2 * k, true) / 100);
      this.near = bytes(scans.distances);
      this.first = [];
      scans.count.reduce((sum, n) => { this.first.push(sum); return sum + n; }, 0);
    }

    build() {
      const button = (name, text, title) => make("button", { type: "button", "data-do": name, title, "aria-label": title }, text);
      this.$base = make("canvas", { class: "rv-base", "aria-hidden": "true" });
      this.$over = make("canvas", { class: "rv-over", tabindex: "0", role: "img", "aria-label":
        "Map with the trajectory. Arrow keys move, plus and minus zoom, 0 shows all, comma and full stop step by scan, n and p go to the next and previous event." });
      this.$place = make("div", { class: "rv-place" });
      this.$scale = make("div", { class: "rv-scale" }, make("i"), make("span"));
      this.$tools = make("div", { class: "rv-tools" }, button("in", "+", "zoom in"), button("out", "−", "zoom out"),
        button("all", "⤢", "show all"), button("measure", "↔", "measure a distance"), button("picture", "PNG", "save the map as a picture"), button("drawing", "SVG", "save the map as a drawing"));
      this.$frame = make("div", { class: "rv-frame" }, this.$base, this.$over, this.$place, this.$scale);
      const [x0, y0, x1, y1] = this.data.extent;
      this.$frame.style.setProperty("--rv-aspect", String(Math.min(Math.max((x1 - x0) / (y1 - y0), 0.8), 3)));
      this.$time = make("input", { type: "range", min: "0", max: String(this.data.end || 1), step: "any", value: "0", "aria-label": "time" });
      this.$now = make("output", { class: "rv-now" });
      this.$event = make("p", { class: "rv-event", role: "status", "aria-live": "polite" });
      this.$kind = make("select", { "aria-label": "kind of event" });
      for (const [kind, text] of KINDS) {
        const n = this.data.events.filter((event) => !kind || event.kind === kind).length;
        if (n || !kind) this.$kind.append(make("option", { value: kind }, `${text} (${n})`));
      }
      const speeds = make("select", { "aria-label": "speed of playing", "data-do": "speed" });
      for (const times of [1, 2, 5, 10, 30, 100]) speeds.append(make("option", { value: String(times), ...(times === 10 ? { selected: "" } : {}) }, `${times}×`));
      this.$play = button("play", "Play", "play");
      const steps = make("div", { class: "rv-steps" }, button("back", "|◂", "previous event"), button("less", "◂", "previous scan"),
        this.$play, button("more", "▸", "next scan"), button("next", "▸|", "next event"), this.$kind, speeds);
      this.$layers = make("div", { class: "rv-layers" });
      this.root.classList.add("rv");
      this.$charts.classList.add("rv", "rv-charts");
      this.root.replaceChildren(this.$frame, this.$tools, make("div", { class: "rv-time" }, steps, this.$time, this.$now), this.$event, this.$layers);
      this.buildLayers();
    }

    buildLayers() {
      const d = this.data, refused = d.loops ? d.loops.accepted.filter((ok) => !ok).length : 0;
      const layers = [
        ["map", "map", d.map, true], ["points", "map points", d.points, true], ["trajectory", d.trajectoryName ?? "trajectory", d.trajectory.t.length, true],
        ...(d.others ?? []).map((other, k) => [`other${k}`, other.name, true, true, other.ink]),
        ["reference", "reference", d.reference, true], ["odometry", "odometry alone", d.odometry, true],
        ["scan", "scan at the cursor", d.scans, true], ["scans", "all scans", d.scans, false],
        ["loops", `loops (${d.loops ? d.loops.accepted.length - refused : 0})`, d.loops && d.loops.accepted.length > refused, true],
        ["refused", `refused loops (${refused})`, refused, false], ["graph", `pose graph (${d.graph?.total} edges)`, d.graph, false], ["ellipses", "2σ ellipses", d.ellipses, false],
        ["places", `places that may be right (${d.ambiguities?.reduce((n, each) => n + each.p.length, 0)})`, d.ambiguities?.length, true],
        ["heat", "distance of scans to the map", d.scans && d.map, false], ["coverage", "coverage: what the lidar has seen", d.coverage, false],
        ...d.marks.map((mark) => [mark.status, `${mark.label} (${mark.t.length})`, true, true]),
      ];
      this.shown = new Set();
      for (const [name, text, there, on, ink] of layers) {
        if (!there) continue;
        const box = make("input", { type: "checkbox", "data-layer": name, ...(on ? { checked: "" } : {}) });
        if (on) this.shown.add(name);
        box.addEventListener("change", () => { if (box.checked) this.shown.add(name); else this.shown.delete(name); this.showLegends(); this.draw(); });
        const key = make("i", { class: `rv-key rv-${name}` }, MARKS[name] || "");
        if (ink) key.style.borderColor = `var(--rv-${ink})`;
        this.$layers.append(make("label", {}, box, key, text));
      }
      const choices = [["plain", "one colour"], ["state", "state", d.trajectory.states.some((state) => state !== "localised")],
        ["error", "error", d.trajectory.error], ["sigma", "standard deviation", d.trajectory.sigma], ["time", "time"]];
      const select = make("select", { "data-do": "colour", "aria-label": "colour of the trajectory" });
      for (const [name, text, there = true] of choices) if (there) select.append(make("option", { value: name }, text));
      this.colourBy = d.trajectory.states.some((state) => state !== "localised") ? "state" : "plain";
      select.value = this.colourBy;
      this.$legend = make("span", { class: "rv-legend" });
      this.$legends = { heat: this.heatLegend(), coverage: this.coverageLegend() };
      this.$layers.append(make("label", {}, "colour by ", select), this.$legend, ...Object.values(this.$legends));
    }

    // --- view: metres (x, y) from the middle at the centre of the canvas, and pixels a metre ---------------------------
    resize() {
      const ratio = devicePixelRatio || 1, { clientWidth: w, clientHeight: h } = this.$frame;
      if (!w || !h) return;
      for (const canvas of [this.$base, this.$over]) { canvas.width = Math.round(w * ratio); canvas.height = Math.round(h * ratio); }
      this.ratio = ratio;
      if (this.whole || !this.scale) this.all(); else this.draw();
      this.charts?.draw();
    }
    all() {
      const [x0, y0, x1, y1] = this.data.extent;
      const side = this.besideTools(), width = this.$base.width - side;
      this.scale = Math.min(width / (x1 - x0), this.$base.height / (y1 - y0));
      [this.x, this.y] = this.middle(width);
      this.x += side / 2 / this.scale;
      this.whole = true;
      this.draw();
    }
    // Width of the column of buttons over the map, in pixels; none where they are below it, as on a phone.
    besideTools() { return getComputedStyle(this.$tools).position === "absolute" ? this.ratio * (this.$tools.offsetWidth + 12) : 0; }
    // Where all is shown there is room beside it or above: rather for more of the map than for what is not known.
    middle(width) {
      const { map, extent: [x0, y0, x1, y1] } = this.data;
      if (!map || map.corner[2] !== 0) return [0, 0];
      const along = (low, high, corner, size, shown) => {
        const first = Math.min(low, corner), last = Math.max(high, corner + size), middle = (low + high) / 2;
        if (last - first <= shown) return (first + last) / 2 - middle;
        return Math.min(Math.max(middle, first + shown / 2), last - shown / 2) - middle;
      };
      return [along(x0, x1, map.corner[0], map.side * map.width, width / this.scale),
        along(y0, y1, map.corner[1], map.side * map.height, this.$base.height / this.scale)];
    }
    zoom(factor, px = this.$base.width / 2, py = this.$base.height / 2) {
      const [mx, my] = this.metres(px, py), size = Math.max(this.data.extent[2] - this.data.extent[0], 1);
      this.scale = Math.min(Math.max(this.scale * factor, 0.1 * this.$base.width / size), 20000);
      const [nx, ny] = this.metres(px, py);
      this.move(this.scale * (nx - mx), -this.scale * (ny - my));
    }
    move(dx, dy) {
      this.x -= dx / this.scale; this.y += dy / this.scale; this.whole = false;
      this.frame();
      clearTimeout(this.resting);
      this.resting = setTimeout(() => this.rest(), REST_MS);
    }
    // Drawn sharp once nothing moves.
    rest() { if (this.still?.scale !== this.scale) this.draw(); }
    metres(px, py) { return [this.x + (px - this.$base.width / 2) / this.scale, this.y - (py - this.$base.height / 2) / this.scale]; }
    pixels(x, y) { return [this.$base.width / 2 + (x - this.x) * this.scale, this.$base.height / 2 - (y - this.y) * this.scale]; }
    // `shift` is where a tile lies.
    flat(c) { c.setTransform(1, 0, 0, 1, ...this.shift); }
    world(c) { const [x, y] = this.pixels(0, 0), [left, top] = this.shift; c.setTransform(this.scale, 0, 0, -this.scale, left + x, top + y); }

    // --- drawing -------------------------------------------------------------------------------------------------------
    ink(name) {
      if (!this.colours) {
        const style = getComputedStyle(this.root);
        this.colours = new Proxy({}, { get: (known, key) => (known[key] ??= style.getPropertyValue(`--rv-${key}`).trim()) });
        this.paths = null;
      }
      return this.colours[name];
    }
    draw() { this.still = null; this.frame(); }
    frame() {
      if (!this.scale || this.drawn) return;
      // Once for each frame of the screen, however many events there were.
      this.drawn = requestAnimationFrame(() => { this.drawn = null; this.drawBase(); this.drawOver(); });
    }
    // What is printed is taken before the next frame.
    drawNow() { this.still = null; if (this.scale) { this.drawBase(); this.drawOver(); } }
    // The map is kept in tiles, in pixels from a place (x, y) at one scale. A pan draws those that come in, and those around
    // the view in advance, one in each frame; while the scale changes, they are shown larger or smaller as long as they cover.
    drawBase() {
      const c = this.$base.getContext("2d"), { width, height } = c.canvas, fresh = () => { this.still = { x: this.x, y: this.y, scale: this.scale, tiles: new Map() }; };
      const place = () => {
        const { x, y, scale, tiles } = this.still, factor = this.scale / scale, size = TILE * factor, [left, top] = this.pixels(x, y).map(Math.round);
        const [i0, j0, i1, j1] = [-left, -top, width - 1 - left, height - 1 - top].map((at) => Math.floor(at / size));
        return { tiles, factor, left, top, i0, j0, i1, j1, missing: this.missing(i0, j0, i1, j1) };
      };
      if (!this.still) fresh();
      let { tiles, factor, left, top, i0, j0, i1, j1, missing } = place();
      if (factor !== 1 && (missing.length || factor > 3 || factor < 0.3)) { fresh(); ({ tiles, factor, left, top, i0, j0, i1, j1, missing } = place()); }
      for (const at of missing) this.drawTile(...at);
      c.setTransform(1, 0, 0, 1, 0, 0);
      c.clearRect(0, 0, width, height);
      const edge = (from, at) => Math.round(from + at * TILE * factor);
      for (let j = j0; j <= j1; j += 1) for (let i = i0; i <= i1; i += 1) {
        c.drawImage(tiles.get(`${i} ${j}`), edge(left, i), edge(top, j), edge(left, i + 1) - edge(left, i), edge(top, j + 1) - edge(top, j));
      }
      this.drawScale();
      if (factor !== 1) return;
      for (const key of tiles.keys()) { const [i, j] = key.split(" ").map(Number); if (i < i0 - 2 || i > i1 + 2 || j < j0 - 2 || j > j1 + 2) tiles.delete(key); }
      const next = this.missing(i0 - 1, j0 - 1, i1 + 1, j1 + 1);
      if (!next.length) return;
      if (!missing.length) this.drawTile(...next[0]);
      this.frame();
    }
    // Tiles of the columns i0 to i1 and rows j0 to j1 that are not drawn.
    missing(i0, j0, i1, j1) {
      const found = [];
      for (let j = j0; j <= j1; j += 1) for (let i = i0; i <= i1; i += 1) if (!this.still.tiles.has(`${i} ${j}`)) found.push([i, j]);
      return found;
    }
    drawTile(i, j) {
      const { x, y } = this, { still, data: d } = this, canvas = make("canvas", { width: TILE, height: TILE }), c = canvas.getContext("2d");
      still.tiles.set(`${i} ${j}`, canvas);
      [this.x, this.y] = [still.x, still.y];
      this.shift = [-this.$base.width / 2 - TILE * i, -this.$base.height / 2 - TILE * j];
      const [left, top] = this.shift, bounds = [...this.metres(-left - 20, TILE - top + 20), ...this.metres(TILE - left + 20, -top - 20)];
      this.world(c);
      if (this.shown.has("map") && this.image && d.map) this.drawGrid(c, this.mapPicture(), d.map);
      if (this.shown.has("coverage")) this.drawGrid(c, this.coverage(), d.coverage);
      this.ink("ink");
      this.paths ??= this.makePaths();
      const px = this.ratio / this.scale, stroke = (path, colour, width, dash = []) => {
        c.strokeStyle = colour; c.lineWidth = width * px; c.setLineDash(dash.map((n) => n * px)); path.stroke(c, this.scale, bounds); c.setLineDash([]);
      };
      c.lineJoin = "bevel"; c.lineCap = "round"; // round joins of thousands of points take twice as long
      if (this.shown.has("heat")) this.drawGrid(c, this.heat().picture, this.heat());
      if (this.shown.has("scans")) for (const k of d.scans.t.keys()) this.drawScan(c, k, 1.2 * px, bounds);
      if (this.shown.has("points")) this.dots(c, d.points, this.ink("ink"), 3 * px, bounds);
      for (const each of this.strokes()) stroke(...each);
      this.drawAxes(c);
      this.drawMarks(c, bounds);
      [this.x, this.y, this.shift] = [x, y, [0, 0]];
    }
    dots(c, columns, colour, size, bounds) {
      c.fillStyle = colour;
      for (const k of columns.x.keys()) { const [x, y] = this.local(columns.x[k], columns.y[k]); if (within(x, y, bounds)) c.fillRect(x - size / 2, y - size / 2, size, size); }
    }
    polyline(columns) {
      const path = new Path(), breaks = new Set(columns?.breaks);
      for (const k of columns ? columns.x.keys() : []) {
        const at = this.local(columns.x[k], columns.y[k]);
        if (k && !breaks.has(k)) path.lineTo(...at); else path.moveTo(...at);
      }
      return path;
    }
    makePaths() {
      const d = this.data, paths = { odometry: this.polyline(d.odometry), reference: this.polyline(d.reference), trajectory: this.coloured(),
        others: (d.others ?? []).map((other) => this.polyline(other)), loops: new Path(), refused: new Path(), ellipses: new Path(), graph: new Path() };
      if (d.loops) for (const k of d.loops.t.keys()) {
        const path = d.loops.accepted[k] ? paths.loops : paths.refused;
        path.moveTo(...this.local(d.loops.x0[k], d.loops.y0[k]));
        path.lineTo(...this.local(d.loops.x1[k], d.loops.y1[k]));
      }
      if (d.graph) for (const [i, j] of d.graph.edges) {
        paths.graph.moveTo(...this.local(d.graph.x[i], d.graph.y[i]));
        paths.graph.lineTo(...this.local(d.graph.x[j], d.graph.y[j]));
      }
      if (d.ellipses) for (const k of d.ellipses.t.keys()) {
        const { xx, xy, yy } = Object.fromEntries(["xx", "xy", "yy"].map((name) => [name, d.ellipses[name][k]]));
        const mean = (xx + yy) / 2, root = Math.hypot((xx - yy) / 2, xy), angle = 0.5 * Math.atan2(2 * xy, xx - yy);
        const [x, y] = this.local(d.ellipses.x[k], d.ellipses.y[k]), a = 2 * Math.sqrt(mean + root), b = 2 * Math.sqrt(Math.max(mean - root, 0));
        paths.ellipses.ellipse(x, y, a, b, angle);
      }
      return paths;
    }
    pointInk(i) { return this.ink(this.near[i] <= NEAR_CM ? "green" : this.near[i] <= FAR_CM ? "orange" : "vermillion"); }
    // Calls work(x, y, i) for each point i of a scan, in the frame of the map.
    eachPoint(k, work) {
      const { x, y, theta, count } = this.data.scans, cos = Math.cos(theta[k]), sin = Math.sin(theta[k]);
      for (let i = this.first[k]; i < this.first[k] + count[k]; i += 1) {
        const bx = this.xy[2 * i], by = this.xy[2 * i + 1];
        work(x[k] + cos * bx - sin * by, y[k] + sin * bx + cos * by, i);
      }
    }
    drawScan(c, k, size, bounds = EVERYWHERE) {
      this.eachPoint(k, (mx, my, i) => {
        const [x, y] = this.local(mx, my);
        if (within(x, y, bounds)) { c.fillStyle = this.pointInk(i); c.fillRect(x - size / 2, y - size / 2, size, size); }
      });
    }
    drawOver() {
      const c = this.$over.getContext("2d"), path = this.data.trajectory, scans = this.data.scans, px = this.ratio / this.scale;
      c.setTransform(1, 0, 0, 1, 0, 0);
      c.clearRect(0, 0, c.canvas.width, c.canvas.height);
      this.world(c);
      if (scans && this.shown.has("scan")) this.drawScan(c, this.scanAt(this.time), Math.max(3.2 * px, 0.02));
      if (path.t.length) {
        const k = before(path.t, this.time), [x, y] = this.local(path.x[k], path.y[k]), size = Math.max(11 * px, 0.2);
        c.save();
        c.translate(x, y); c.rotate(path.theta[k]);
        c.beginPath(); c.moveTo(size, 0); c.lineTo(-0.7 * size, 0.6 * size); c.lineTo(-0.4 * size, 0); c.lineTo(-0.7 * size, -0.6 * size); c.closePath();
        c.fillStyle = this.ink("robot"); c.fill();
        c.strokeStyle = this.ink("halo"); c.lineWidth = 1.2 * px; c.stroke();
        c.restore();
      }
      this.drawStated(c, px);
      if (this.arrow) this.drawArrow(c, px);
      if (this.measure?.length) {
        const [a, b = a] = this.measure;
        c.strokeStyle = c.fillStyle = this.ink("robot"); c.lineWidth = 2 * px;
        c.beginPath(); c.moveTo(...a); c.lineTo(...b); c.stroke();
        for (const end of [a, b]) { c.beginPath(); c.arc(...end, 4 * px, 0, 2 * Math.PI); c.fill(); }
      }
    }

    // --- time ----------------------------------------------------------------------------------------------------------
    scanAt(t) {
      const times = this.data.scans.t, k = before(times, t);
      return k + 1 < times.length && times[k + 1] - t < t - times[k] ? k + 1 : k;
    }
    seek(t) {
      const path = this.data.trajectory, scans = this.data.scans;
      this.time = Math.min(Math.max(t, 0), this.data.end);
      this.$time.value = String(this.time);
      const words = [`${this.time.toFixed(1)} s`];
      if (path.t.length) {
        const k = before(path.t, this.time);
        words.push(`x ${path.x[k].toFixed(2)}, y ${path.y[k].toFixed(2)} m, ${(180 * path.theta[k] / Math.PI).toFixed(1)}°`, path.states[path.state[k]].replaceAll("_", " "));
        if (path.sigma?.[k] != null) words.push(`σ ${length(path.sigma[k])}`);
        if (path.error?.[k] != null) words.push(`error ${length(path.error[k])}`);
      }
      if (scans) { const k = this.scanAt(this.time); words.push(`scan at ${scans.t[k].toFixed(1).replace("-0.0", "0.0")} s ${scans.status[k]}`); }
      this.$now.textContent = words.join(" · ");
      this.charts.now = this.time;
      this.charts.cursor(this.time);
      if (this.scale) this.drawOver();
      this.root.dispatchEvent(new CustomEvent("seek", { detail: this.time }));
    }
    step(steps) {
      const times = this.data.scans ? this.data.scans.t : this.data.trajectory.t;
      if (!times.length) return;
      const k = this.data.scans ? this.scanAt(this.time) : before(times, this.time);
      this.seek(times[Math.min(Math.max(k + steps, 0), times.length - 1)]);
    }
    jump(forward) {
      const events = this.data.events.filter((event) => !this.$kind.value || event.kind === this.$kind.value);
      const found = forward ? events.find((event) => event.t > this.time + 1e-6) : events.findLast((event) => event.t < this.time - 1e-6);
      this.$event.textContent = found ? `${found.kind} at ${found.t.toFixed(1)} s${found.text ? `: ${found.text}` : ""}` : "no further event";
      if (!found) return;
      this.seek(found.t);
      const path = this.data.trajectory, k = before(path.t, found.t);
      const [px, py] = this.pixels(...this.local(path.x[k], path.y[k])), { width, height } = this.$base;
      if (px < 0 || py < 0 || px > width || py > height) this.move(width / 2 - px, height / 2 - py);
    }
    stop() { cancelAnimationFrame(this.playing); this.playing = null; this.$play.textContent = "Play"; }
    play() {
      if (this.playing !== null) { this.stop(); return; }
      if (this.time >= this.data.end) this.seek(0);
      let last = performance.now();
      this.$play.textContent = "Stop";
      const step = (now) => {
        this.seek(this.time + this.speed * (now - last) / 1000);
        last = now;
        if (this.time < this.data.end) this.playing = requestAnimationFrame(step); else this.stop();
      };
      this.playing = requestAnimationFrame(step);
    }
  }
  Object.assign(ResultView.prototype, globalThis.ResultLayers.methods);
  globalThis.ResultView = ResultView;
})();
