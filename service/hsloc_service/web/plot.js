// Curves along time on a canvas: the error in position (left axis) and in heading (right axis), or the fitness.

import { ink } from "./viewer.js";

function ticks(high) {
  const power = 10 ** Math.floor(Math.log10(high || 1));
  const step = [0.2, 0.5, 1, 2].map((s) => s * power).find((s) => high / s <= 5) || power;
  const found = [];
  for (let v = 0; v <= high * 1.0001; v += step) found.push(v);
  return found;
}

export function plot(canvas, data, now) {
  const ratio = window.devicePixelRatio || 1, c = canvas.getContext("2d");
  canvas.width = canvas.clientWidth * ratio;
  canvas.height = canvas.clientHeight * ratio;
  const curves = data.errors
    ? [["position", "trajectory", "m", data.errors], ["heading", "odometry", "deg", data.errors]]
    : [["fitness", "trajectory", "", data.fitness]];
  const left = 48 * ratio, right = canvas.width - (curves.length > 1 ? 48 : 8) * ratio;
  const top = 20 * ratio, bottom = canvas.height - 22 * ratio;
  const t = curves[0][3].t, end = t.length ? t[t.length - 1] : 1;
  const px = (seconds) => left + (right - left) * seconds / (end || 1);
  c.font = `${11 * ratio}px system-ui, sans-serif`;
  c.strokeStyle = ink("line");
  c.fillStyle = ink("quiet");
  c.lineWidth = ratio;
  for (const v of ticks(end)) c.fillText(`${Number(v.toPrecision(4))} s`, Math.min(px(v), right - 30 * ratio), bottom + 15 * ratio);
  curves.forEach(([name, style, unit, columns], which) => {
    const values = columns[name], high = Math.max(1e-9, ...values.filter((v) => v !== null)) * 1.05;
    const py = (v) => bottom - (bottom - top) * v / high;
    c.fillStyle = ink(which ? style : "quiet");
    for (const v of ticks(high)) {
      if (!which) { c.beginPath(); c.moveTo(left, py(v)); c.lineTo(right, py(v)); c.strokeStyle = ink("line"); c.stroke(); }
      c.fillText(String(Number(v.toPrecision(2))), which ? right + 5 * ratio : 6 * ratio, py(v) + 4 * ratio);
    }
    c.fillStyle = ink(style);
    c.fillText(`${name}${unit ? ` [${unit}]` : ""}`, which ? right - 60 * ratio : left, 12 * ratio);
    c.strokeStyle = ink(style);
    c.lineWidth = 1.5 * ratio;
    c.beginPath();
    const alone = [];
    values.forEach((v, k) => {
      if (v === null) return;
      const before = k > 0 && values[k - 1] !== null, after = k + 1 < values.length && values[k + 1] !== null;
      if (before) c.lineTo(px(columns.t[k]), py(v)); else c.moveTo(px(columns.t[k]), py(v));
      if (!before && !after) alone.push(k);
    });
    c.stroke();
    // A value between two gaps has no line: the reference of some logs is a sample now and then.
    c.fillStyle = ink(style);
    for (const k of alone) { c.beginPath(); c.arc(px(columns.t[k]), py(values[k]), 2 * ratio, 0, 2 * Math.PI); c.fill(); }
  });
  if (Number.isFinite(now)) {
    c.strokeStyle = ink("robot");
    c.beginPath();
    c.moveTo(px(now), top);
    c.lineTo(px(now), bottom);
    c.stroke();
  }
}
