"use strict";
// Curves over time, and one line for each status of the scans, below the map: see view.js.
(() => {
  const STATUS = { matched: "green", predicted: "sky", rejected: "vermillion", no_returns: "orange", searching: "purple", relocalised: "blue" };
  const LEFT = 46, RIGHT = 10, TOP = 8, BOTTOM = 20;
  const make = (tag, className = "", text = "") => { const made = document.createElement(tag); made.className = className; made.textContent = text; return made; };

  // At most about `count` round numbers within [low, high].
  function ticks(low, high, count) {
    if (!(high > low)) return [low];
    const rough = (high - low) / count, power = 10 ** Math.floor(Math.log10(rough));
    const step = [1, 2, 5, 10].map((times) => times * power).find((each) => each >= rough * 0.999999);
    const found = [];
    for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k += 1) found.push(Number((k * step).toPrecision(12)));
    return found;
  }
  const number = (value) => String(Number(value.toPrecision(4))).replace("-", "−");
  function nearest(times, t) {
    let low = 0, high = times.length - 1;
    while (low < high) { const middle = (low + high) >> 1; if (times[middle] < t) low = middle + 1; else high = middle; }
    return low > 0 && t - times[low - 1] < times[low] - t ? low - 1 : low;
  }

  // Fills `root`; returns {now, draw, cursor(t), end}; `now` is where the cursor goes back to. `seek(t)` is called for a click, and while the pointer is dragged.
  globalThis.ResultCharts = (root, data, seek) => {
    const end = data.end || 1, plots = [];
    const minutes = end > 300, factor = minutes ? 60 : 1;

    function follow(element, left, right) {
      const at = (event) => {
        const box = element.getBoundingClientRect();
        return end * Math.min(Math.max((event.clientX - box.left - left) / (box.width - left - right), 0), 1);
      };
      element.addEventListener("pointerdown", (event) => { element.setPointerCapture(event.pointerId); seek(at(event)); });
      element.addEventListener("pointermove", (event) => { if (event.buttons) seek(at(event)); else api.cursor(at(event)); });
      element.addEventListener("pointerleave", () => api.cursor(api.now));
    }

    for (const chart of data.charts) {
      const figure = make("figure", "rv-chart"), head = make("figcaption", "", chart.title), output = make("output");
      head.append(make("small", "", chart.unit ? ` ${chart.unit}` : ""), output);
      head.title = chart.explanation;
      const canvas = make("canvas"), line = make("i", "rv-cursor"), box = make("div", "rv-plot");
      canvas.setAttribute("role", "img");
      canvas.setAttribute("aria-label", `${chart.title}${chart.unit ? ` in ${chart.unit}` : ""} over ${chart.time ? "time" : "evaluations"}. ${chart.explanation}`);
      box.append(canvas);
      if (chart.time) box.append(line);
      figure.append(head, box, make("p", "rv-help", chart.explanation));
      root.append(figure);
      plots.push({ chart, canvas, line, output });
      if (chart.time) follow(box, LEFT, RIGHT);
    }
    if (data.status.length) {
      const table = make("div", "rv-status");
      for (const row of data.status) {
        const canvas = make("canvas"), line = make("i", "rv-cursor"), box = make("div", "rv-strip");
        canvas.setAttribute("role", "img");
        canvas.setAttribute("aria-label", `when scans were ${row.label}`);
        box.append(canvas, line);
        table.append(make("span", "", row.label), make("span", "rv-count", String(row.count)), box);
        plots.push({ row, canvas, line });
        follow(box, 0, 0);
      }
      root.append(table);
    }

    function prepare(canvas) {
      const ratio = devicePixelRatio || 1, w = canvas.clientWidth, h = canvas.clientHeight;
      canvas.width = Math.round(w * ratio);
      canvas.height = Math.round(h * ratio);
      const c = canvas.getContext("2d");
      c.setTransform(ratio, 0, 0, ratio, 0, 0);
      return [c, w, h];
    }
    function drawChart({ chart, canvas }, ink) {
      const [c, w, h] = prepare(canvas);
      if (!w) return;
      const curves = [{ t: chart.t, v: chart.v, ink: "blue" }, ...(chart.others ?? [])];
      const values = [...curves.flatMap((curve) => curve.v), ...(chart.marks ? chart.marks.v : [])].filter((v) => v !== null), last = chart.time ? end : chart.t.at(-1) || 1;
      const top = chart.top ?? (values.reduce((a, b) => Math.max(a, b), 0) * 1.08 || 1), sorted = [...values].sort((a, b) => a - b);
      const bottom = chart.log ? Math.max(sorted[Math.floor(0.01 * sorted.length)], sorted[sorted.length >> 1] / 30) : chart.top ? Math.max(0, sorted[0] - 0.08) : 0;
      const part = chart.log ? (v) => Math.log(Math.max(v, bottom) / bottom) / Math.log(top / bottom) : (v) => (v - bottom) / (top - bottom || 1);
      const x = (t) => LEFT + (w - LEFT - RIGHT) * Math.min(Math.max(t / last, 0), 1), y = (v) => h - BOTTOM - (h - TOP - BOTTOM) * part(v);
      c.fillStyle = ink("lost");
      if (chart.time) for (const [begin, until] of data.lost) c.fillRect(x(begin), TOP, Math.max(x(until) - x(begin), 1), h - TOP - BOTTOM);
      c.font = "11px system-ui, sans-serif"; c.textBaseline = "middle"; c.textAlign = "right"; c.strokeStyle = ink("rule"); c.lineWidth = 1;
      const powers = []; for (let p = Math.ceil(Math.log10(bottom || 1) - 1e-9); chart.log && 10 ** p <= top; p += 1) powers.push(10 ** p);
      for (const v of chart.log && powers.length > 1 ? powers : ticks(bottom, top, 4)) {
        c.beginPath(); c.moveTo(LEFT, y(v)); c.lineTo(w - RIGHT, y(v)); c.stroke();
        c.fillStyle = ink("muted"); c.fillText(number(v), LEFT - 5, y(v));
      }
      c.textAlign = "center";
      const scale = chart.time ? factor : 1, unit = chart.time ? (minutes ? " min" : " s") : "";
      for (const v of ticks(0, last / scale, Math.max(2, Math.floor(w / 80)))) c.fillText(`${number(v)}${v === 0 ? unit : ""}`, x(v * scale), h - BOTTOM / 2);
      for (const curve of curves) {
        c.strokeStyle = ink(curve.ink); c.lineWidth = 1.3; c.lineJoin = "round"; c.beginPath();
        let pen = false;
        for (const k of curve.t.keys()) {
          if (curve.v[k] === null) { pen = false; continue; }
          // A value between two gaps is a dot.
          if (pen) c.lineTo(x(curve.t[k]), y(curve.v[k])); else { c.moveTo(x(curve.t[k]), y(curve.v[k])); c.lineTo(x(curve.t[k]) + 1, y(curve.v[k])); }
          pen = true;
        }
        c.stroke();
      }
      c.strokeStyle = ink("vermillion"); c.beginPath();
      for (const k of chart.marks ? chart.marks.t.keys() : []) {
        const px = x(chart.marks.t[k]), py = y(chart.marks.v[k]);
        c.moveTo(px - 3, py - 3); c.lineTo(px + 3, py + 3); c.moveTo(px - 3, py + 3); c.lineTo(px + 3, py - 3);
      }
      c.stroke();
    }
    function drawRow({ row, canvas }, ink) {
      const [c, w, h] = prepare(canvas);
      c.fillStyle = ink(STATUS[row.status] || "blue");
      for (const [begin, until] of row.runs) c.fillRect(w * begin / end, 0, Math.max(w * (until - begin) / end, 0.8), h);
    }
    const api = {
      now: 0,
      draw() {
        const style = getComputedStyle(root), ink = (name) => style.getPropertyValue(`--rv-${name}`).trim();
        for (const plot of plots) if (plot.chart) drawChart(plot, ink); else drawRow(plot, ink);
        api.cursor(api.now);
      },
      cursor(t) {
        for (const { chart, canvas, line, output } of plots) {
          if (chart && !chart.time) continue;
          const w = canvas.clientWidth, [left, right] = chart ? [LEFT, RIGHT] : [0, 0];
          line.style.transform = `translateX(${left + (w - left - right) * Math.min(t / end, 1)}px)`;
          if (!output || !chart.t.length) continue;
          const value = chart.v[nearest(chart.t, t)];
          const space = chart.unit === "°" ? "" : " ";
          output.textContent = value === null ? "–" : `${Math.abs(value) < 0.01 && value !== 0 ? "< 0.01" : Number(value.toPrecision(3))}${space}${chart.unit}`;
        }
      },
      end() { root.replaceChildren(); },
    };
    return api;
  };
})();
