"use strict";
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const map = document.getElementById("map"), frame = map.parentElement;
  const scale = frame.querySelector(".scale"), place = frame.querySelector(".place"), here = document.getElementById("here");
  const middle = { x: Number(map.dataset.x), y: Number(map.dataset.y) };
  const grid = map.querySelector(".grid");
  const whole = map.viewBox.baseVal, all = { x: whole.x, y: whole.y, w: whole.width, h: whole.height };
  let view = { ...all }, wholeIsShown = true;

  // The view always has the frame's shape, so that a metre is as many pixels everywhere.
  function show(next) {
    const box = map.getBoundingClientRect();
    if (!box.width || !box.height) return;
    const aspect = box.width / box.height, size = Math.max(all.w, all.h);
    let w = Math.min(Math.max(next.w, size / 2000), size * 4), h = w / aspect;
    wholeIsShown = Boolean(next.whole);
    if (next.whole) { w = Math.max(next.w, next.h * aspect); h = w / aspect; }
    view = { x: next.x + (next.w - w) / 2, y: next.y + (next.h - h) / 2, w, h };
    map.setAttribute("viewBox", `${view.x} ${view.y} ${w} ${h}`);
    const unit = w / box.width;
    map.style.setProperty("--u", unit);
    if (grid) grid.classList.toggle("near", Number(grid.dataset.cell) / unit > 1.5);
    const rough = 110 * unit, power = 10 ** Math.floor(Math.log10(rough));
    const length = [5, 2, 1].map((step) => step * power).find((step) => step <= rough * 1.000001) || power;
    scale.hidden = false;
    scale.firstElementChild.style.width = `${length / unit}px`;
    const text = length >= 1000 ? [length / 1000, "km"] : length >= 1 ? [length, "m"] : [length * 100, "cm"];
    scale.lastElementChild.textContent = `${Number(text[0].toPrecision(3))} ${text[1]}`;
  }
  const showAll = () => show({ ...all, whole: true });
  function zoom(factor, at) {
    at = at || { x: view.x + view.w / 2, y: view.y + view.h / 2 };
    const size = Math.max(all.w, all.h), w = Math.min(Math.max(view.w * factor, size / 2000), size * 4), k = w / view.w;
    show({ x: at.x - (at.x - view.x) * k, y: at.y - (at.y - view.y) * k, w, h: view.h * k });
  }
  function metres(event) {
    const box = map.getBoundingClientRect();
    return {
      x: view.x + ((event.clientX - box.left) / box.width) * view.w,
      y: view.y + ((event.clientY - box.top) / box.height) * view.h,
    };
  }

  const fingers = new Map();
  map.addEventListener("wheel", (event) => {
    // An untouched map lets the page scroll by.
    if (!event.ctrlKey && document.activeElement !== map) return;
    event.preventDefault();
    zoom(Math.exp(Math.max(-200, Math.min(200, event.deltaY)) * 0.002), metres(event));
  }, { passive: false });
  map.addEventListener("pointerdown", (event) => {
    map.focus({ preventScroll: true });
    fingers.set(event.pointerId, event);
    map.setPointerCapture(event.pointerId);
  });
  map.addEventListener("pointermove", (event) => {
    const point = metres(event);
    place.textContent = `${(point.x + middle.x).toFixed(2)}, ${(middle.y - point.y).toFixed(2)} m`;
    const before = fingers.get(event.pointerId);
    if (!before) return;
    const others = [...fingers.values()].filter((finger) => finger.pointerId !== event.pointerId);
    if (others.length === 1) {
      const apart = (a, b) => Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY) || 1;
      zoom(apart(before, others[0]) / apart(event, others[0]), metres(others[0]));
    } else if (!others.length) {
      const unit = view.w / map.getBoundingClientRect().width;
      show({ ...view, x: view.x - (event.clientX - before.clientX) * unit, y: view.y - (event.clientY - before.clientY) * unit });
    }
    fingers.set(event.pointerId, event);
  });
  for (const name of ["pointerup", "pointercancel"]) map.addEventListener(name, (event) => fingers.delete(event.pointerId));
  map.addEventListener("pointerleave", () => { place.textContent = ""; });
  map.addEventListener("dblclick", (event) => zoom(0.5, metres(event)));
  map.addEventListener("keydown", (event) => {
    const step = view.w / 8, moves = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
    const move = moves[event.key];
    if (move) show({ ...view, x: view.x + move[0] * step, y: view.y + move[1] * step });
    else if (event.key === "+" || event.key === "=") zoom(0.7);
    else if (event.key === "-") zoom(1 / 0.7);
    else if (event.key === "0") showAll();
    else return;
    event.preventDefault();
  });
  for (const button of document.querySelectorAll("[data-zoom]")) {
    button.addEventListener("click", () => ({ in: () => zoom(0.6), out: () => zoom(1 / 0.6), all: showAll })[button.dataset.zoom]());
  }
  for (const box of document.querySelectorAll("[data-toggle]")) {
    box.addEventListener("change", () => {
      for (const layer of map.querySelectorAll(`[data-layer="${box.dataset.toggle}"]`)) layer.style.display = box.checked ? "" : "none";
    });
  }
  addEventListener("resize", () => (wholeIsShown ? showAll() : show(view)));
  addEventListener("beforeprint", showAll);
  showAll();

  // One time under the pointer, in all charts and on the map.
  const charts = [...document.querySelectorAll(".chart[data-time]")];
  function nearest(times, t) {
    let low = 0, high = times.length - 1;
    while (low < high) { const mid = (low + high) >> 1; if (times[mid] < t) low = mid + 1; else high = mid; }
    return low > 0 && t - times[low - 1] < times[low] - t ? low - 1 : low;
  }
  function bounds(chart) {
    const all = chart.viewBox.baseVal.width, left = Number(chart.dataset.left || 46);
    return { left, width: all - left - Number(chart.dataset.right || 8), all };
  }
  function point(t) {
    for (const chart of charts) {
      const edge = bounds(chart), cursor = chart.querySelector(".cursor");
      cursor.setAttribute("visibility", t === null ? "hidden" : "visible");
      if (t !== null) cursor.setAttribute("transform", `translate(${edge.left + (edge.width * t) / Number(chart.dataset.end)} 0)`);
    }
    for (const output of document.querySelectorAll("output[data-for]")) {
      const curve = data.charts[output.dataset.for];
      if (!curve) continue;
      const value = t === null || !curve.t.length ? null : curve.v[nearest(curve.t, t)];
      output.textContent = t === null ? "" : `${t.toFixed(1)} s: ${value === null ? "–" : Number(value.toPrecision(3))} ${curve.unit}`;
    }
    if (t === null || !data.path.t.length) { here.setAttribute("visibility", "hidden"); return; }
    const row = nearest(data.path.t, t);
    here.setAttribute("visibility", "visible");
    here.setAttribute("transform", `translate(${data.path.x[row] - middle.x} ${middle.y - data.path.y[row]})`);
  }
  for (const chart of charts) {
    chart.addEventListener("pointermove", (event) => {
      const box = chart.getBoundingClientRect(), edge = bounds(chart);
      const part = (((event.clientX - box.left) / box.width) * edge.all - edge.left) / edge.width;
      point(Math.min(Math.max(part, 0), 1) * Number(chart.dataset.end));
    });
    chart.addEventListener("pointerleave", () => point(null));
  }
})();
