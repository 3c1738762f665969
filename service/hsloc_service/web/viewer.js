// The map with its paths on a canvas: zoom, pan, scrub along time; by mouse, fingers and keys.

const PATHS = ["reference", "odometry", "trajectory"];
const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();

// `light-dark()` in a custom property is resolved by the browser only where it is used.
export function ink(name) {
  const probe = document.createElement("i");
  probe.style.color = `var(--${name})`;
  document.body.append(probe);
  const value = getComputedStyle(probe).color;
  probe.remove();
  return value || colour(name);
}

export class Viewer {
  constructor(canvas, onTime) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    this.onTime = onTime;
    this.shown = new Set(PATHS);
    this.time = Infinity;
    this.pointers = new Map();
    new ResizeObserver(() => this.resize()).observe(canvas);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.draw());
    this.listen();
  }

  show(data, image) {
    this.data = data;
    this.image = image;
    this.time = Infinity;
    this.resize();
    this.all();
  }

  // The view: metres (x, y) at the centre of the canvas, and pixels a metre.
  all() {
    if (!this.data) return;
    const xs = [], ys = [];
    for (const [x, y] of this.corners()) { xs.push(x); ys.push(y); }
    for (const name of PATHS) {
      const path = this.data[name];
      if (path && name !== "odometry") { xs.push(...path.x); ys.push(...path.y); }
    }
    const low = [Math.min(...xs), Math.min(...ys)], high = [Math.max(...xs), Math.max(...ys)];
    this.x = (low[0] + high[0]) / 2;
    this.y = (low[1] + high[1]) / 2;
    this.scale = 0.94 * Math.min(this.canvas.width / (high[0] - low[0] || 1), this.canvas.height / (high[1] - low[1] || 1));
    this.draw();
  }

  corners() {
    const map = this.data.map, [ox, oy, theta] = map.origin;
    const w = map.width * map.resolution, h = map.height * map.resolution;
    return [[0, 0], [w, 0], [w, h], [0, h]].map(([x, y]) =>
      [ox + x * Math.cos(theta) - y * Math.sin(theta), oy + x * Math.sin(theta) + y * Math.cos(theta)]);
  }

  resize() {
    const ratio = window.devicePixelRatio || 1;
    const { clientWidth: w, clientHeight: h } = this.canvas;
    if (!w || !h) return;
    if (this.canvas.width !== Math.round(w * ratio) || this.canvas.height !== Math.round(h * ratio)) {
      this.canvas.width = Math.round(w * ratio);
      this.canvas.height = Math.round(h * ratio);
    }
    this.draw();
  }

  zoom(factor, px = this.canvas.width / 2, py = this.canvas.height / 2) {
    const [mx, my] = this.metres(px, py);
    this.scale = Math.min(Math.max(this.scale * factor, 0.05), 20000);
    const [nx, ny] = this.metres(px, py);
    this.x += mx - nx;
    this.y += my - ny;
    this.draw();
  }

  move(dx, dy) {
    this.x -= dx / this.scale;
    this.y += dy / this.scale;
    this.draw();
  }

  metres(px, py) {
    return [this.x + (px - this.canvas.width / 2) / this.scale, this.y - (py - this.canvas.height / 2) / this.scale];
  }

  setTime(t) {
    this.time = t;
    this.draw();
  }

  end() {
    const t = this.data.trajectory.t;
    return t.length ? t[t.length - 1] : 0;
  }

  at(path, time) {
    let low = 0, high = path.t.length - 1;
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (path.t[middle] <= time) low = middle; else high = middle - 1;
    }
    return low;
  }

  draw() {
    if (!this.data || !this.scale) return;
    const c = this.context, { width, height } = this.canvas, ratio = window.devicePixelRatio || 1;
    c.setTransform(1, 0, 0, 1, 0, 0);
    c.clearRect(0, 0, width, height);
    c.setTransform(this.scale, 0, 0, -this.scale, width / 2 - this.x * this.scale, height / 2 + this.y * this.scale);
    this.drawMap(c);
    for (const name of PATHS) {
      if (this.data[name] && this.shown.has(name)) this.drawPath(c, this.data[name], ink(name), name, ratio);
    }
    this.drawRobot(c, ratio);
    this.drawScale(c, ratio);
  }

  drawMap(c) {
    const map = this.data.map, [ox, oy, theta] = map.origin;
    c.save();
    c.translate(ox, oy);
    c.rotate(theta);
    c.scale(map.resolution, -map.resolution);
    c.imageSmoothingEnabled = this.scale * map.resolution < 1;
    if (matchMedia("(prefers-color-scheme: dark)").matches) c.filter = "invert(0.88)";
    if (this.image) c.drawImage(this.image, 0, -map.height, map.width, map.height);
    c.filter = "none";
    c.restore();
  }

  drawPath(c, path, style, name, ratio) {
    const last = name === "trajectory" || this.time !== Infinity ? this.at(path, this.time) : path.t.length - 1;
    c.beginPath();
    for (let k = 0; k <= last; k += 1) {
      if (k === 0) c.moveTo(path.x[k], path.y[k]); else c.lineTo(path.x[k], path.y[k]);
    }
    c.strokeStyle = style;
    c.lineWidth = (name === "trajectory" ? 2.5 : 1.8) * ratio / this.scale;
    c.setLineDash(name === "odometry" ? [6 * ratio / this.scale, 4 * ratio / this.scale] : []);
    c.lineJoin = "round";
    c.stroke();
    c.setLineDash([]);
  }

  drawRobot(c, ratio) {
    const path = this.data.trajectory;
    if (!path.t.length) return;
    const k = this.at(path, this.time);
    const size = Math.max(9 * ratio / this.scale, 0.2);
    c.save();
    c.translate(path.x[k], path.y[k]);
    c.rotate(path.theta[k]);
    c.beginPath();
    c.moveTo(size, 0);
    c.lineTo(-0.7 * size, 0.6 * size);
    c.lineTo(-0.4 * size, 0);
    c.lineTo(-0.7 * size, -0.6 * size);
    c.closePath();
    c.fillStyle = ink("robot");
    c.fill();
    c.restore();
  }

  drawScale(c, ratio) {
    c.setTransform(1, 0, 0, 1, 0, 0);
    const wanted = 100 * ratio / this.scale, power = 10 ** Math.floor(Math.log10(wanted));
    const metres = power * (wanted / power >= 5 ? 5 : wanted / power >= 2 ? 2 : 1);
    const length = metres * this.scale, x = 14 * ratio, y = this.canvas.height - 14 * ratio;
    c.strokeStyle = c.fillStyle = ink("ink");
    c.lineWidth = 2 * ratio;
    c.beginPath();
    c.moveTo(x, y - 5 * ratio); c.lineTo(x, y); c.lineTo(x + length, y); c.lineTo(x + length, y - 5 * ratio);
    c.stroke();
    c.font = `${12 * ratio}px system-ui, sans-serif`;
    c.fillText(metres >= 1 ? `${metres} m` : `${Math.round(metres * 100)} cm`, x + 5 * ratio, y - 5 * ratio);
  }

  listen() {
    const canvas = this.canvas, ratio = () => window.devicePixelRatio || 1;
    const place = (event) => [event.offsetX * ratio(), event.offsetY * ratio()];
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(-event.deltaY * (event.ctrlKey ? 0.01 : 0.0015)), ...place(event));
    }, { passive: false });
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      this.pointers.set(event.pointerId, place(event));
    });
    canvas.addEventListener("pointermove", (event) => {
      const before = this.pointers.get(event.pointerId);
      if (!before) return;
      const now = place(event), others = [...this.pointers].filter(([id]) => id !== event.pointerId).map(([, p]) => p);
      if (others.length === 1) {
        const was = Math.hypot(before[0] - others[0][0], before[1] - others[0][1]);
        const is = Math.hypot(now[0] - others[0][0], now[1] - others[0][1]);
        if (was > 0) this.zoom(is / was, (now[0] + others[0][0]) / 2, (now[1] + others[0][1]) / 2);
      } else {
        this.move(now[0] - before[0], now[1] - before[1]);
      }
      this.pointers.set(event.pointerId, now);
    });
    for (const kind of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(kind, (event) => this.pointers.delete(event.pointerId));
    }
    canvas.addEventListener("keydown", (event) => {
      const step = 60 * ratio();
      const actions = {
        ArrowLeft: () => this.move(step, 0), ArrowRight: () => this.move(-step, 0),
        ArrowUp: () => this.move(0, step), ArrowDown: () => this.move(0, -step),
        "+": () => this.zoom(1.25), "=": () => this.zoom(1.25), "-": () => this.zoom(0.8), 0: () => this.all(),
        ",": () => this.onTime(-1), ".": () => this.onTime(1),
      };
      if (actions[event.key]) { event.preventDefault(); actions[event.key](); }
    });
  }
}
