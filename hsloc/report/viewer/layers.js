"use strict";
// What lies on the map of a result: lines, marks, axes, heat map. Methods of `ResultView`, which is in view.js.
(() => {
  const STATES = { localised: "blue", predicted: "sky", ambiguous: "orange", off_map: "vermillion", lost: "purple" };
  // Viridis at eight places (S. van der Walt and N. Smith, 2015): even in lightness, readable for the colour-blind.
  const SCALE = ["#440154", "#46327e", "#365c8d", "#277f8e", "#1fa187", "#4ac16d", "#a0da39", "#fde725"];
  const MARKS = { rejected: "✕", no_returns: "▼", relocalised: "★", appeared: "✚", vanished: "◌", to_check: "⚠\uFE0E" };
  const MARK_PX = { relocalised: 20, appeared: 16, vanished: 20, to_check: 24 };
  const PLACE = [[13, 0], [-9, 8], [-5, 0], [-9, -8]]; // an arrow, in pixels
  const PIECE = 256, THIN_PX = 0.5; // points or ellipses that are stroked at once; points that are closer (pixels) are joined
  const HEAT_M = 0.3, HEAT_CELLS = 240; // where the scale ends; cells along the longer side of the extent
  const LEVELS = 16; // steps of a count for each doubling, as in view.py
  const make = (tag, attributes = {}, ...children) => {
    const made = document.createElement(tag);
    for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
    made.append(...children);
    return made;
  };
  const scaleKey = (share, text) => { const key = make("i", { class: "rv-key" }); key.style.borderColor = inkOf(share); return [key, `${text} `]; };
  const length = globalThis.lengthText;
  // The last row whose time is not after t.
  const before = (times, t) => {
    let low = 0, high = times.length - 1;
    while (low < high) { const middle = (low + high + 1) >> 1; if (times[middle] <= t) low = middle; else high = middle - 1; }
    return low;
  };

  const within = (x, y, [x0, y0, x1, y1]) => x >= x0 && x <= x1 && y >= y0 && y <= y1;
  // Colour from a scale for a share of its length.
  const inkOf = (share) => SCALE[Math.max(Math.min(Math.floor(SCALE.length * share), SCALE.length - 1), 0)];

  // Lines and ellipses in metres: strokes on a canvas, and the same as text for a drawing.
  class Path {
    constructor() { this.x = []; this.y = []; this.starts = new Set(); this.ellipses = []; }
    moveTo(x, y) { this.starts.add(this.x.length); this.lineTo(x, y); }
    lineTo(x, y) { this.x.push(x); this.y.push(y); }
    ellipse(x, y, a, b, angle) { this.ellipses.push([x, y, a, b, angle]); }
    // Pieces with their bounds, so that those out of sight are left out; points closer than `least` (m) are joined.
    pieces(least) {
      if (this.least === least) return this.made;
      const made = [], begin = (x, y) => made.push({ path: new Path2D(), n: 0, x0: x, y0: y, x1: x, y1: y });
      const add = (x, y, reach = 0) => {
        const piece = made.at(-1);
        piece.n += 1;
        piece.x0 = Math.min(piece.x0, x - reach); piece.x1 = Math.max(piece.x1, x + reach);
        piece.y0 = Math.min(piece.y0, y - reach); piece.y1 = Math.max(piece.y1, y + reach);
        return piece.path;
      };
      let px, py;
      for (const [k, x] of this.x.entries()) {
        const y = this.y[k], start = this.starts.has(k), last = k + 1 === this.x.length || this.starts.has(k + 1);
        if (!start && !last && Math.abs(x - px) < least && Math.abs(y - py) < least) continue;
        if (start || made.at(-1).n >= PIECE) {
          if (!made.length || made.at(-1).n >= PIECE) begin(start ? x : px, start ? y : py);
          const path = add(start ? x : px, start ? y : py);
          path.moveTo(start ? x : px, start ? y : py);
        }
        if (!start) add(x, y).lineTo(x, y);
        px = x; py = y;
      }
      for (const [k, [x, y, a, b, angle]] of this.ellipses.entries()) {
        if (k % PIECE === 0) begin(x, y);
        const path = add(x, y, a);
        path.moveTo(x + a * Math.cos(angle), y + a * Math.sin(angle));
        path.ellipse(x, y, a, b, angle, 0, 2 * Math.PI);
      }
      this.least = least; this.made = made;
      return made;
    }
    // What lies in [x0, y0, x1, y1] (m); `scale` in pixels a metre.
    stroke(c, scale, [x0, y0, x1, y1]) {
      for (const piece of this.pieces(THIN_PX / 2 ** Math.ceil(Math.log2(scale)))) {
        if (piece.x1 >= x0 && piece.x0 <= x1 && piece.y1 >= y0 && piece.y0 <= y1) c.stroke(piece.path);
      }
    }
    toString() {
      const text = (value) => Number(value.toFixed(4));
      const lines = this.x.map((x, k) => `${this.starts.has(k) ? "M" : "L"} ${text(x)} ${text(this.y[k])}`);
      const ellipses = this.ellipses.map(([x, y, a, b, angle]) => {
        const dx = a * Math.cos(angle), dy = a * Math.sin(angle), arc = `A ${text(a)} ${text(b)} ${text(180 * angle / Math.PI)} 1 1`;
        return `M ${text(x + dx)} ${text(y + dy)} ${arc} ${text(x - dx)} ${text(y - dy)} ${arc} ${text(x + dx)} ${text(y + dy)}`;
      });
      return [...lines, ...ellipses].join(" ");
    }
  }

  const methods = {
    // All lines that are shown, the lowest first: path, colour, width and dashes in pixels of the page.
    strokes() {
      const paths = this.paths, on = (name) => this.shown.has(name), found = [];
      if (on("odometry")) found.push([paths.odometry, this.ink("vermillion"), 1.3, [2, 4]]);
      if (on("graph")) found.push([paths.graph, this.ink("sky"), 1]);
      if (on("refused")) found.push([paths.refused, this.ink("vermillion"), 1, [3, 4]]);
      if (on("loops")) found.push([paths.loops, this.ink("green"), 1.6]);
      if (on("trajectory")) for (const [colour, path] of paths.trajectory) found.push([path, colour, 2.6]);
      paths.others.forEach((path, k) => { if (on(`other${k}`)) found.push([path, this.ink(this.data.others[k].ink), 2]); });
      if (on("reference")) found.push([paths.reference, this.ink("ink"), 1.1, [6, 4]]);
      if (on("ellipses")) found.push([paths.ellipses, this.ink("purple"), 1.2]);
      return found;
    },
    mapPicture() { return this.dark.matches ? (this.inverted ??= this.invert()) : this.image; },
    invert() {
      const canvas = make("canvas"), c = canvas.getContext("2d");
      canvas.width = this.data.map.width; canvas.height = this.data.map.height;
      c.drawImage(this.image, 0, 0);
      const pixels = c.getImageData(0, 0, canvas.width, canvas.height);
      for (let k = 0; k < pixels.data.length; k += 4) for (let i = 0; i < 3; i += 1) pixels.data[k + i] = 242 - 0.88 * pixels.data[k + i];
      c.putImageData(pixels, 0, 0);
      return canvas;
    },
    // A picture of cells with this side (m); the corner is the lower left one, and the direction of the rows.
    drawGrid(c, picture, { side, width, height, corner: [x, y, theta] }) {
      c.save();
      c.translate(...this.local(x, y));
      c.rotate(theta);
      c.scale(side, -side);
      c.imageSmoothingEnabled = this.scale * side < 1.5;
      c.drawImage(picture, 0, -height, width, height);
      c.restore();
    },
    // A picture of cells, each with a colour of the scale (0 to 1); those without a share are clear.
    painted(width, height, shares, alpha) {
      const canvas = make("canvas"), c = canvas.getContext("2d");
      canvas.width = width; canvas.height = height;
      const pixels = c.createImageData(width, height);
      for (const [at, share] of shares) {
        const ink = inkOf(share);
        for (let i = 0; i < 3; i += 1) pixels.data[4 * at + i] = parseInt(ink.slice(1 + 2 * i, 3 + 2 * i), 16);
        pixels.data[4 * at + 3] = Math.round(255 * alpha);
      }
      c.putImageData(pixels, 0, 0);
      return canvas;
    },
    // By how many scans each place was seen, by doublings; walls stay visible below. Made once.
    coverage() {
      if (!this.covered) {
        const { width, height, most } = this.data.coverage, shares = new Map();
        this.levels = Uint8Array.from(atob(this.data.coverage.levels), (letter) => letter.charCodeAt(0));
        for (const [at, level] of this.levels.entries()) if (level) shares.set(at, level / (LEVELS * Math.log2(1 + most)));
        this.covered = this.painted(width, height, shares, 0.7);
      }
      return this.covered;
    },
    // Scans that saw a place (m, from the middle), or null where the layer is not shown.
    scansAt(lx, ly) {
      if (!this.shown.has("coverage")) return null;
      const { side, width, height, corner: [x, y, theta] } = this.data.coverage, dx = lx + this.ox - x, dy = ly + this.oy - y;
      const cos = Math.cos(theta), sin = Math.sin(theta), column = Math.floor((cos * dx + sin * dy) / side), row = Math.floor((cos * dy - sin * dx) / side);
      if (column < 0 || row < 0 || column >= width || row >= height) return 0;
      this.coverage();
      return Math.round(2 ** (this.levels[(height - 1 - row) * width + column] / LEVELS) - 1);
    },
    coverageLegend() {
      const made = make("span", { class: "rv-legend", hidden: "" }), { most = 1 } = this.data.coverage ?? {}, steps = [];
      for (let n = 1; n < most / 2; n *= 10) steps.push(n);
      made.append("scans that saw a place: ", ...[...steps, most].flatMap((n) => scaleKey(Math.log2(1 + n) / Math.log2(1 + most), n)), "· without colour: never seen");
      return made;
    },
    // Mean distance to the map of the scans' points in each cell; made once.
    heat() {
      if (this.cells) return this.cells;
      const [x0, y0, x1, y1] = this.data.extent, side = Math.max(x1 - x0, y1 - y0) / HEAT_CELLS;
      const width = Math.ceil((x1 - x0) / side), height = Math.ceil((y1 - y0) / side), sums = new Map();
      for (const k of this.data.scans.x.keys()) this.eachPoint(k, (x, y, i) => {
        const column = Math.floor((x - x0) / side), row = Math.floor((y - y0) / side);
        if (column < 0 || row < 0 || column >= width || row >= height) return;
        const at = (height - 1 - row) * width + column, cell = sums.get(at) ?? [0, 0];
        cell[0] += this.near[i] / 100; cell[1] += 1;
        sums.set(at, cell);
      });
      const shares = [...sums].map(([at, [sum, n]]) => [at, sum / n / HEAT_M]);
      this.cells = { side, width, height, corner: [x0, y0, 0], picture: this.painted(width, height, shares, 1) };
      return this.cells;
    },
    heatLegend() {
      const made = make("span", { class: "rv-legend", hidden: "" }, "mean distance to the map ");
      for (let k = 0; k < SCALE.length; k += 2) made.append(...scaleKey(k / SCALE.length, k ? length(HEAT_M * k / SCALE.length) : "0"));
      made.append("and more");
      return made;
    },
    showLegends() { for (const [name, legend] of Object.entries(this.$legends)) legend.hidden = !this.shown.has(name); },
    // Where the frame of the map has its origin, and its axes.
    drawAxes(c) {
      this.flat(c);
      const [px, py] = this.pixels(...this.local(0, 0)), r = this.ratio;
      c.font = `${11 * r}px system-ui, sans-serif`; c.textAlign = "center"; c.textBaseline = "middle"; c.lineWidth = 1.6 * r;
      for (const [dx, dy, name, colour] of [[28, 0, "x", "vermillion"], [0, -28, "y", "green"]]) {
        c.strokeStyle = c.fillStyle = this.ink(colour);
        c.beginPath(); c.moveTo(px, py); c.lineTo(px + dx * r, py + dy * r); c.stroke();
        c.fillText(name, px + 1.3 * dx * r, py + 1.3 * dy * r);
      }
    },
    // One path for each colour; the legend says what the colours mean.
    coloured() {
      const path = this.data.trajectory, breaks = new Set(path.breaks), found = new Map(), by = this.colourBy;
      let colour = () => this.ink("blue");
      this.$legend.replaceChildren();
      const entry = (ink, text) => { const key = make("i", { class: "rv-key" }); key.style.borderColor = ink; this.$legend.append(key, `${text} `); };
      if (by === "state") {
        const inks = path.states.map((state) => this.ink(STATES[state] || "ink"));
        colour = (k) => inks[path.state[k]];
        path.states.forEach((state, k) => entry(inks[k], state.replaceAll("_", " ")));
      } else if (by !== "plain") {
        const values = by === "time" ? path.t : path[by], known = values.filter((v) => v !== null).sort((a, b) => a - b);
        const low = by === "time" ? 0 : Math.min(known[0] ?? 0, 0), high = (by === "time" ? known.at(-1) : known[Math.floor(0.98 * (known.length - 1))]) || 1;
        colour = (k) => values[k] === null ? this.ink("muted") : inkOf((values[k] - low) / (high - low));
        const text = (v) => by === "time" ? `${v.toFixed(0)} s` : length(v);
        entry(SCALE[0], text(low)); entry(SCALE[4], text((low + high) / 2)); entry(SCALE[7], by === "time" ? text(high) : `${text(high)} and more`);
      }
      let last = null;
      for (const k of path.x.keys()) {
        const ink = colour(k), at = this.local(path.x[k], path.y[k]);
        if (!found.has(ink)) found.set(ink, new Path());
        const target = found.get(ink);
        if (k === 0 || breaks.has(k)) target.moveTo(...at);
        else { if (last !== ink) target.moveTo(...this.local(path.x[k - 1], path.y[k - 1])); target.lineTo(...at); }
        last = ink;
      }
      return found;
    },
    // The places between which the run does not decide, in pixels: an arrow along the heading, and its label.
    placeMarks() {
      const found = [], r = this.ratio;
      for (const each of this.shown.has("places") ? this.data.ambiguities : []) for (const [k, text] of each.labels.entries()) {
        const [px, py] = this.pixels(...this.local(each.x[k], each.y[k])), cos = Math.cos(each.theta[k]), sin = -Math.sin(each.theta[k]);
        const middle = [px, py], start = () => this.startOf(each, k), outline = PLACE.map(([x, y]) => [px + r * (cos * x - sin * y), py + r * (sin * x + cos * y)]);
        found.push({ outline, text, at: [px, py + 20 * r], middle, start });
      }
      return found;
    },
    placeMarkAt(px, py) { return this.placeMarks().find(({ middle: [x, y] }) => Math.hypot(px - x, py - y) < 16 * this.ratio); },
    // Where the robot was at the first pose if it is at place k later: back along the trajectory, whose jumps are no motion.
    startOf({ at, x, y, theta }, k) {
      const path = this.data.trajectory, breaks = new Set(path.breaks);
      let px = x[k], py = y[k], yaw = theta[k];
      for (let row = path.t.length ? before(path.t, at + 1e-6) : 0; row > 0; row -= 1) {
        if (breaks.has(row)) continue;
        const turn = yaw - path.theta[row], cos = Math.cos(turn), sin = Math.sin(turn);
        const dx = path.x[row - 1] - path.x[row], dy = path.y[row - 1] - path.y[row];
        px += cos * dx - sin * dy; py += sin * dx + cos * dy; yaw = path.theta[row - 1] + turn;
      }
      return [px, py, Math.atan2(Math.sin(yaw), Math.cos(yaw))];
    },
    drawPlaces(c) {
      c.textAlign = "center"; c.textBaseline = "middle"; c.font = `600 ${13 * this.ratio}px system-ui, sans-serif`; c.lineJoin = "round";
      for (const { outline, text, at } of this.placeMarks()) {
        c.beginPath();
        outline.forEach(([x, y], k) => { if (k) c.lineTo(x, y); else c.moveTo(x, y); });
        c.closePath();
        c.fillStyle = this.ink("orange"); c.strokeStyle = this.ink("ink"); c.lineWidth = 1.4 * this.ratio; c.fill(); c.stroke();
        c.strokeStyle = this.ink("halo"); c.lineWidth = 3.5 * this.ratio; c.strokeText(text, ...at);
        c.fillStyle = this.ink("ink"); c.fillText(text, ...at);
      }
    },
    // The last and the first pose in pixels, with their labels; where the two are near, these lie on different sides.
    endMarks() {
      const { x, y } = this.data.trajectory, n = x.length, r = 9 * this.ratio;
      if (!n || !this.shown.has("trajectory")) return [];
      const [first, last] = [0, n - 1].map((k) => this.pixels(...this.local(x[k], y[k])));
      const near = Math.abs(first[0] - last[0]) < 60 * this.ratio && Math.abs(first[1] - last[1]) < 20 * this.ratio, left = near && first[0] < last[0];
      const mark = (name, colour, at, isLeft) => ({ name, colour, at, align: isLeft ? "right" : "left", text: [at[0] + (isLeft ? -r : r), at[1] - r] });
      return [mark("end", "vermillion", last, near && !left), mark("start", "green", first, left)];
    },
    markInk: (mark) => ({ rejected: "vermillion", to_check: "vermillion", vanished: "vermillion", appeared: "green" })[mark.status] ?? "orange",
    // Why there is a mark at a pixel, or why a loop through it was refused; null where nothing is.
    reasonAt(px, py) {
      const { marks, loops } = this.data, at = (x, y) => this.pixels(...this.local(x, y));
      for (const mark of marks) for (const k of this.shown.has(mark.status) ? mark.t.keys() : []) {
        const [x, y] = at(mark.x[k], mark.y[k]);
        if (Math.hypot(px - x, py - y) < 14 * this.ratio && mark.reason?.[k]) return mark.reason[k];
      }
      for (const k of loops?.t.keys() ?? []) {
        if (!this.shown.has(loops.accepted[k] ? "loops" : "refused")) continue;
        const [x, y] = at(loops.x0[k], loops.y0[k]), [ex, ey] = at(loops.x1[k], loops.y1[k]), dx = ex - x, dy = ey - y;
        const along = Math.min(Math.max(((px - x) * dx + (py - y) * dy) / (dx * dx + dy * dy || 1), 0), 1);
        if (Math.hypot(px - x - along * dx, py - y - along * dy) < 6 * this.ratio) return loops.accepted[k] ? "loop closed" : `loop refused: ${loops.reason[k]}`;
      }
      return null;
    },
    drawMarks(c, bounds) {
      this.flat(c);
      c.textAlign = "center"; c.textBaseline = "middle";
      for (const mark of this.data.marks) {
        if (!this.shown.has(mark.status)) continue;
        c.font = `${(MARK_PX[mark.status] ?? 12) * this.ratio}px system-ui, sans-serif`;
        c.fillStyle = this.ink(this.markInk(mark));
        c.strokeStyle = this.ink("halo"); c.lineWidth = 4 * this.ratio;
        for (const k of mark.t.keys()) {
          const place = this.local(mark.x[k], mark.y[k]), at = this.pixels(...place);
          if (!within(...place, bounds)) continue;
          if (mark.status === "to_check") c.strokeText(MARKS[mark.status], ...at);
          c.fillText(MARKS[mark.status], ...at);
        }
      }
      for (const { name, colour, at: [px, py], align, text } of this.endMarks()) {
        const r = 6 * this.ratio;
        c.beginPath(); c.arc(px, py, r, 0, 2 * Math.PI); c.fillStyle = this.ink(colour); c.fill();
        c.strokeStyle = this.ink("halo"); c.lineWidth = 2 * this.ratio; c.stroke();
        c.font = `600 ${13 * this.ratio}px system-ui, sans-serif`; c.textAlign = align; c.lineWidth = 3 * this.ratio;
        c.strokeText(name, ...text); c.fillStyle = this.ink("ink"); c.fillText(name, ...text);
      }
      this.drawPlaces(c);
    },
    drawScale() {
      const rough = 110 * this.ratio / this.scale, power = 10 ** Math.floor(Math.log10(rough));
      const metres = [5, 2, 1].map((step) => step * power).find((step) => step <= rough * 1.000001) || power;
      this.$scale.firstChild.style.width = `${metres * this.scale / this.ratio}px`;
      this.$scale.lastChild.textContent = metres >= 1000 ? `${metres / 1000} km` : metres >= 1 ? `${metres} m` : `${Number((100 * metres).toPrecision(3))} cm`;
    },
    // Loops that the user states, and the places that are clicked for the next one.
    drawStated(c, px) {
      const path = this.data.trajectory, place = (t) => {
        const k = before(path.t, t + 1e-9);
        return this.local(path.x[k], path.y[k]);
      };
      const lines = [...this.stated, ...(this.picked.length ? [[...this.picked, "robot"]] : [])];
      for (const line of lines) {
        const ink = this.ink(line.at(-1)), ends = line.slice(0, -1).map(place);
        c.strokeStyle = c.fillStyle = ink; c.lineWidth = 2.5 * px;
        c.beginPath(); c.moveTo(...ends[0]); c.lineTo(...ends.at(-1)); c.stroke();
        for (const end of ends) { c.beginPath(); c.arc(...end, 5 * px, 0, 2 * Math.PI); c.fill(); }
      }
    },
    drawArrow(c, px) {
      const [[x, y], [tx, ty]] = this.arrow, length = Math.hypot(tx - x, ty - y), head = Math.min(14 * px, length / 2);
      c.save();
      c.translate(x, y); c.rotate(Math.atan2(ty - y, tx - x));
      c.strokeStyle = c.fillStyle = this.ink("robot"); c.lineWidth = 3 * px;
      c.beginPath(); c.arc(0, 0, 5 * px, 0, 2 * Math.PI); c.fill();
      c.beginPath(); c.moveTo(0, 0); c.lineTo(length - head, 0); c.stroke();
      c.beginPath(); c.moveTo(length, 0); c.lineTo(length - head, head / 2); c.lineTo(length - head, -head / 2); c.closePath(); c.fill();
      c.restore();
    },
  };
  globalThis.ResultLayers = { MARKS, MARK_PX, Path, before, make, within, methods };
})();
