"use strict";
// Several results side by side: paths on the map of the first, curves over each other, figures with their differences.
(() => {
  const INKS = ["blue", "vermillion", "green", "purple", "orange", "sky", "robot", "muted"];
  const NUMBER = /^[<>]? ?-?[\d.]+ ?(mm|cm|m|km|°|%.*)?$/; // the text of a figure that is one number
  const make = (tag, text = "", className = "") => { const made = document.createElement(tag); made.textContent = text; made.className = className; return made; };

  // As hsloc/report/html.py: see there.
  function changeOf(first, number, text) {
    if (first === null || number === null || first === number || !NUMBER.test(text)) return "";
    const signed = (value, digits) => `${value > 0 ? "+" : "−"}${Math.abs(value).toFixed(digits)}`;
    if (text.includes("%")) { const points = 100 * (number - first); return Math.abs(points) < 0.05 ? "" : `${signed(points, 1)} pp`; }
    if (first === 0) return "";
    const factor = number / first, percent = 100 * (factor - 1);
    if (factor >= 10 || (factor > 0 && factor <= 0.1)) return `× ${factor < 10 ? Number(factor.toPrecision(1)) : factor.toFixed(0)}`;
    return Math.abs(percent) < 0.05 ? "" : `${signed(percent, Math.abs(percent) < 10 ? 1 : 0)} %`;
  }
  function change(first, figure) {
    if (!first || !figure || figure.numbers?.length !== figure.values.length || first.numbers?.length !== figure.values.length) return "";
    const parts = figure.values.map((text, k) => changeOf(first.numbers[k], figure.numbers[k], text));
    return parts.some(Boolean) ? parts.map((part) => part || "0 %").join(" / ") : "";
  }

  // A table in a box that scrolls: the box, the row of its head, and its body.
  function grid(title) {
    const box = make("div", "", "scroll"), table = make("table", "", "rv-table"), head = table.createTHead().insertRow(), body = table.createTBody();
    box.tabIndex = 0; box.setAttribute("role", "region"); box.setAttribute("aria-label", title);
    head.append(make("td"));
    box.append(table);
    return [box, head, body];
  }
  const heading = (scope, ...content) => { const made = make("th"); made.scope = scope; made.append(...content); return made; };

  class ResultComparison {
    // `runs` are {name, href, data, image}: the value of hsloc/report/view.py, and the picture of its map.
    // `seeds` are {names, rows}, or null: see over_seeds in hsloc/report/html.py.
    constructor(root, runs, seeds = null) {
      this.root = root;
      const view = make("div"), charts = make("div"), first = runs[0];
      const built = runs.some((run) => run.data.summary?.mode === "slam");
      view.setAttribute("role", "region"); view.setAttribute("aria-label", "map with all paths");
      charts.setAttribute("role", "region"); charts.setAttribute("aria-label", "curves over time");
      root.replaceChildren(this.table(runs), ...(seeds ? this.overSeeds(seeds) : []), make("h2", `Paths on the map of ${first.name}`));
      if (built) root.append(make("p", "A map that a run built has a frame of its own, which begins at the first pose of the log.", "rv-help"));
      const maps = new Set(runs.map((run) => { const map = run.data.summary?.facts[0] ?? ""; return map.endsWith("map of the log") ? `${map} ${run.data.title}` : map; }));
      if (!built && maps.size > 1) root.append(make("p", `The runs are on different maps: on that of ${first.name} the paths of the others may mean nothing.`, "rv-help"));
      root.append(view, charts);
      const data = { ...first.data, end: Math.max(...runs.map((run) => run.data.end)), others: [], charts: [], status: [] };
      data.extent = [0, 1, 2, 3].map((k) => Math[k < 2 ? "min" : "max"](...runs.map((run) => run.data.extent[k])));
      runs.forEach((run, k) => { if (k) data.others.push({ ...run.data.trajectory, name: run.name, ink: INKS[k % INKS.length] }); });
      data.trajectoryName = first.name;
      for (const chart of first.data.charts) {
        if (!chart.time) continue;
        const others = runs.map((run, k) => ({ ...run.data.charts.find((each) => each.name === chart.name), ink: INKS[k % INKS.length] })).slice(1).filter((each) => each.t);
        data.charts.push({ ...chart, others });
      }
      this.view = new globalThis.ResultView(view, data, first.image, charts);
    }

    table(runs) {
      const [box, head, body] = grid("figures of all runs");
      runs.forEach((run, k) => {
        const key = make("i", "", "rv-key"), name = make(run.href ? "a" : "span", run.name);
        if (run.href) name.href = run.href;
        key.style.borderColor = `var(--rv-${INKS[k % INKS.length]})`;
        head.append(heading("col", key, " ", name));
      });
      const line = (name, contents, explanation = "", changes = []) => {
        const row = body.insertRow(), label = heading("row", name);
        label.title = explanation;
        row.append(label);
        contents.forEach((content, k) => { const cell = make("td"); cell.append(content, ...(changes[k] ? [" ", make("small", changes[k], "rv-change")] : [])); row.append(cell); });
      };
      line("verdict", runs.map((run) => run.data.summary?.verdict ? make("span", run.data.summary.verdict, `rv-verdict rv-${run.data.summary.verdict}`) : ""));
      const figures = runs.map((run) => new Map((run.data.summary?.figures ?? []).map((figure) => [figure.name, figure])));
      for (const name of new Set([...figures].sort((a, b) => b.size - a.size).flatMap((each) => [...each.keys()]))) {
        const first = figures[0].get(name), any = figures.find((each) => each.has(name)).get(name);
        line(name, figures.map((each) => each.get(name)?.values.join(" / ") ?? "–"), any.explanation,
          figures.map((each, k) => k ? change(first, each.get(name)) : ""));
      }
      return box;
    }

    overSeeds({ names, rows }) {
      const [box, head, body] = grid("figures over seeds");
      head.append(...names.map((name) => heading("col", name)));
      for (const [name, ...cells] of rows) body.insertRow().append(heading("row", name), ...cells.map((text) => make("td", text)));
      return [make("h2", "Over seeds"), make("p", "Mean ± standard deviation of runs that differ in their seed alone, and the 95 % interval of the mean (bootstrap).", "rv-help"), box];
    }

    end() { this.view.end(); this.root.replaceChildren(); }
  }
  globalThis.ResultComparison = ResultComparison;
})();
