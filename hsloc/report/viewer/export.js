"use strict";
// The map as it is shown, as a picture or as a drawing whose lines stay sharp: see view.js.
(() => {
  function save(view, blob, ending) {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(blob);
    link.download = `${view.data.title || "map"}.${ending}`;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10000);
  }

  function picture(view) {
    const canvas = document.createElement("canvas"), c = canvas.getContext("2d");
    canvas.width = view.$base.width; canvas.height = view.$base.height;
    c.fillStyle = view.ink("ground"); c.fillRect(0, 0, canvas.width, canvas.height);
    c.drawImage(view.$base, 0, 0); c.drawImage(view.$over, 0, 0);
    canvas.toBlob((blob) => save(view, blob, "png"));
  }

  const NAMESPACE = new DOMParser().parseFromString("<svg></svg>", "text/html").querySelector("svg").namespaceURI;
  const node = (name, attributes, ...children) => {
    const made = document.createElementNS(NAMESPACE, name);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, String(value));
    made.append(...children);
    return made;
  };
  const fixed = (value) => Number(value.toFixed(4));

  // The points of a scan by colour, as dots: paths of no length with round ends.
  function dots(view, k, found) {
    view.eachPoint(k, (x, y, i) => {
      const ink = view.pointInk(i);
      if (!found.has(ink)) found.set(ink, []);
      found.get(ink).push(`M${fixed(x - view.ox)} ${fixed(y - view.oy)}h0`);
    });
  }

  function drawing(view) {
    const { width, height } = view.$base, { ratio, scale } = view, data = view.data;
    const [tx, ty] = view.pixels(0, 0), on = (name) => view.shown.has(name);
    const world = node("g", { transform: `matrix(${scale} 0 0 ${-scale} ${tx} ${ty})`, fill: "none", "stroke-linejoin": "round", "stroke-linecap": "round" });
    const cells = (image, { side, width: w, height: h, corner: [x, y, theta] }) => {
      const canvas = document.createElement("canvas"), [lx, ly] = view.local(x, y);
      canvas.width = w; canvas.height = h;
      canvas.getContext("2d").drawImage(image, 0, 0);
      world.append(node("image", { href: canvas.toDataURL(), width: w, height: h, "image-rendering": "pixelated",
        transform: `translate(${lx} ${ly}) rotate(${180 * theta / Math.PI}) scale(${side} ${-side}) translate(0 ${-h})` }));
    };
    if (on("map") && view.image && data.map) cells(view.mapPicture(), data.map);
    if (on("coverage")) cells(view.coverage(), data.coverage);
    if (on("heat")) cells(view.heat().picture, view.heat());
    const stroke = (d, ink, pixels, dash = []) => world.append(node("path", { d, stroke: ink, "stroke-width": pixels * ratio,
      "stroke-dasharray": dash.map((n) => n * ratio).join(" "), "vector-effect": "non-scaling-stroke" }));
    const clouds = new Map();
    if (on("scans")) for (const k of data.scans.t.keys()) dots(view, k, clouds);
    if (data.scans && on("scan")) dots(view, view.scanAt(view.time), clouds);
    for (const [ink, parts] of clouds) stroke(parts.join(""), ink, 1.6);
    for (const [path, ink, pixels, dash] of view.strokes()) stroke(String(path), ink, pixels, dash);
    const page = node("svg", { viewBox: `0 0 ${width} ${height}`, width: width / ratio, height: height / ratio, "font-family": "system-ui, sans-serif" },
      node("title", {}, data.title), node("rect", { width, height, fill: view.ink("ground") }), world);
    const text = (words, x, y, ink, size, anchor = "middle") => page.append(node("text", { x: fixed(x), y: fixed(y), fill: ink, "font-size": size * ratio,
      "text-anchor": anchor, "dominant-baseline": "central", "paint-order": "stroke", stroke: view.ink("halo"), "stroke-width": 2 * ratio }, words));
    for (const mark of data.marks) {
      if (!on(mark.status)) continue;
      for (const k of mark.t.keys()) text(globalThis.ResultLayers.MARKS[mark.status], ...view.pixels(...view.local(mark.x[k], mark.y[k])), view.ink(view.markInk(mark)), globalThis.ResultLayers.MARK_PX[mark.status] ?? 12);
    }
    for (const { outline, text: words, at } of view.placeMarks()) {
      page.append(node("polygon", { points: outline.map((xy) => xy.map(fixed).join(",")).join(" "), fill: view.ink("orange"), stroke: view.ink("ink"), "stroke-width": 1.4 * ratio }));
      text(words, ...at, view.ink("ink"), 13);
    }
    for (const { name, colour, at: [cx, cy], align, text: place } of view.endMarks()) {
      page.append(node("circle", { cx: fixed(cx), cy: fixed(cy), r: 6 * ratio, fill: view.ink(colour), stroke: view.ink("halo"), "stroke-width": 2 * ratio }));
      text(name, ...place, view.ink("ink"), 13, align === "left" ? "start" : "end");
    }
    const bar = view.$scale.firstChild.getBoundingClientRect().width * ratio, y = height - 12 * ratio, x = width - 12 * ratio - bar;
    page.append(node("rect", { x: fixed(x), y, width: fixed(bar), height: 4 * ratio, fill: view.ink("ink") }));
    text(view.$scale.lastChild.textContent, x + bar / 2, y - 10 * ratio, view.ink("ink"), 12);
    save(view, new Blob([new XMLSerializer().serializeToString(page)], { type: "image/svg+xml" }), "svg");
  }

  globalThis.saveView = { picture, drawing };
})();
