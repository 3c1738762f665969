"use strict";
// Mouse, fingers and keys of the map: see view.js, whose `ResultView` is the `view` here.
// As the figures are written, but centimetres also of what is longer than ten metres.
globalThis.lengthText = (m) => {
  if (m < 5e-6) return "0 mm";
  const [factor, unit] = m < 0.00095 ? [1000, "mm"] : m < 0.9995 ? [100, "cm"] : [1, "m"], value = factor * m;
  return `${value.toFixed(value < 9.995 || unit === "m" ? 2 : value < 99.95 ? 1 : 0)} ${unit}`;
};
globalThis.listenToView = (view) => {
  function nearest(px, py, within = 14) {
    const path = view.data.trajectory, [mx, my] = view.metres(px, py);
    let best = null, least = (within * view.ratio / view.scale) ** 2;
    for (let k = 0; k < path.x.length; k += 1) {
      const [x, y] = view.local(path.x[k], path.y[k]), far = (x - mx) ** 2 + (y - my) ** 2;
      if (far < least) { least = far; best = k; }
    }
    return best;
  }
  // The start of the run that leads to the place that may be right at a pixel, or null.
  const place = (px, py) => (view.startable && !view.picking && view.placeMarkAt(px, py)?.start()) || null;
  function hover(px, py) {
    const [x, y] = view.metres(px, py), k = nearest(px, py), path = view.data.trajectory;
    const words = [`${(x + view.ox).toFixed(2)}, ${(y + view.oy).toFixed(2)} m`];
    if (k !== null) words.push(`${path.t[k].toFixed(1)} s, ${path.states[path.state[k]].replaceAll("_", " ")}`);
    const start = place(px, py), reason = view.reasonAt(px, py);
    if (reason) words.push(reason);
    const seen = view.scansAt(x, y);
    if (seen !== null) words.push(seen ? `seen by ${seen} scans` : "never seen");
    if (start) words.push("click: run again, with the start that leads to this place");
    view.$over.classList.toggle("rv-hit", Boolean(start));
    if (view.measure?.length) { const [a, b = [x, y]] = view.measure; words.push(`distance ${globalThis.lengthText(Math.hypot(b[0] - a[0], b[1] - a[1]))}`); }
    view.$place.textContent = words.join(" · ");
    view.charts.cursor(k === null ? view.time : path.t[k]);
  }
  function click(px, py) {
    if (view.measure) {
      if (view.measure.length > 1) view.measure = [];
      view.measure.push(view.metres(px, py));
      hover(px, py);
      view.drawOver();
      return;
    }
    const start = place(px, py);
    if (start) {
      const tail = view.local(...start), length = 60 * view.ratio / view.scale;
      view.setPose([tail, [tail[0] + length * Math.cos(start[2]), tail[1] + length * Math.sin(start[2])]]);
      view.root.dispatchEvent(new CustomEvent("pose", { detail: start }));
      return;
    }
    const k = nearest(px, py, view.picking ? 40 : 14);
    if (k === null) return;
    const t = view.data.trajectory.t[k];
    if (view.picking) view.picked = [...(view.picked.length > 1 ? [] : view.picked), t];
    view.seek(t);
    if (view.picking && view.picked.length > 1) {
      view.root.dispatchEvent(new CustomEvent("loop", { detail: [...view.picked].sort((a, b) => a - b) }));
    }
  }
  const { signal } = view.listening, over = view.$over, at = (event) => [event.offsetX * view.ratio, event.offsetY * view.ratio];
  over.addEventListener("wheel", (event) => {
    // An untouched map lets the page scroll by.
    if (!event.ctrlKey && document.activeElement !== over) return;
    event.preventDefault();
    view.zoom(Math.exp(-Math.max(-200, Math.min(200, event.deltaY)) * 0.002), ...at(event));
  }, { passive: false });
  over.addEventListener("pointerdown", (event) => {
    over.focus({ preventScroll: true });
    over.setPointerCapture(event.pointerId);
    view.fingers.set(event.pointerId, at(event));
    view.pressed = at(event);
  });
  over.addEventListener("pointermove", (event) => {
    const was = view.fingers.get(event.pointerId), now = at(event);
    if (was && view.posing) { view.setPose([view.metres(...view.pressed), view.metres(...now)]); return; }
    if (!was) { hover(...now); return; }
    const others = [...view.fingers].filter(([id]) => id !== event.pointerId).map(([, at]) => at);
    if (others.length === 1) {
      const apart = ([x, y]) => Math.hypot(x - others[0][0], y - others[0][1]) || 1;
      view.zoom(apart(now) / apart(was), (now[0] + others[0][0]) / 2, (now[1] + others[0][1]) / 2);
    } else if (!others.length) view.move(now[0] - was[0], now[1] - was[1]);
    view.fingers.set(event.pointerId, now);
  });
  over.addEventListener("pointerup", (event) => {
    const now = at(event);
    if (view.posing && view.fingers.size === 1) {
      view.fingers.clear();
      const [[x, y], [tx, ty]] = view.arrow ?? [[0, 0], [0, 0]];
      if (tx === x && ty === y) return; // a click has no heading
      pose();
      view.root.dispatchEvent(new CustomEvent("pose", { detail: [x + view.ox, y + view.oy, Math.atan2(ty - y, tx - x)] }));
      return;
    }
    if (view.fingers.size === 1 && view.pressed && Math.hypot(now[0] - view.pressed[0], now[1] - view.pressed[1]) < 4 * view.ratio) click(...now);
    view.fingers.delete(event.pointerId);
  });
  over.addEventListener("pointercancel", (event) => view.fingers.delete(event.pointerId));
  over.addEventListener("pointerleave", () => { view.$place.textContent = ""; view.charts.cursor(view.time); });
  over.addEventListener("dblclick", (event) => view.zoom(2, ...at(event)));
  const measure = () => { view.measure = view.measure ? null : []; over.classList.toggle("rv-measuring", Boolean(view.measure)); view.drawOver(); };
  const toggle = (name, on) => {
    over.classList.toggle("rv-measuring", on);
    view.root.querySelector(`[data-do=${name}]`).setAttribute("aria-pressed", String(on));
    view.drawOver();
  };
  const pose = () => {
    view.posing = !view.posing;
    view.arrow = view.posing ? null : view.arrow;
    toggle("pose", view.posing);
  };
  const loop = () => {
    view.picking = !view.picking;
    view.picked = [];
    toggle("loop", view.picking);
    view.root.dispatchEvent(new CustomEvent("loop", { detail: [] }));
  };
  const actions = { pose, loop, in: () => view.zoom(1.5), out: () => view.zoom(1 / 1.5), all: () => view.all(), measure, picture: () => globalThis.saveView.picture(view), drawing: () => globalThis.saveView.drawing(view),
    play: () => view.play(), less: () => view.step(-1), more: () => view.step(1), back: () => view.jump(false), next: () => view.jump(true) };
  view.root.addEventListener("click", (event) => actions[event.target.closest?.("button[data-do]")?.dataset.do]?.(), { signal });
  view.root.addEventListener("change", (event) => {
    if (event.target.dataset.do === "speed") view.speed = Number(event.target.value);
    if (event.target.dataset.do === "colour") { view.colourBy = event.target.value; view.paths = null; view.draw(); }
  }, { signal });
  view.$time.addEventListener("input", () => view.seek(Number(view.$time.value)));
  const step = 60, keys = { ArrowLeft: () => view.move(step, 0), ArrowRight: () => view.move(-step, 0), ArrowUp: () => view.move(0, step),
    ArrowDown: () => view.move(0, -step), "+": () => view.zoom(1.25), "=": () => view.zoom(1.25), "-": () => view.zoom(0.8), 0: () => view.all(),
    ",": () => view.step(-1), ".": () => view.step(1), " ": () => view.play(), n: () => view.jump(true), p: () => view.jump(false) };
  over.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || !keys[event.key]) return;
    event.preventDefault();
    keys[event.key]();
  });
};
