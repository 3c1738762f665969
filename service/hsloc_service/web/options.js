// The form of a run's options, made from /v1/options: whatever the server offers can be chosen here.

import { config, finder } from "./parameters.js";

const FILES = ["map", "align_to", "relations", "reference", "calibration", "resume"]; // chosen elsewhere on the page

function control(option) {
  let made;
  if (option.kind === "choice") {
    made = document.createElement("select");
    if (option.default === null) made.append(new Option("default", ""));
    made.append(...option.choices.map((choice) => new Option(choice, choice, choice === option.default, choice === option.default)));
  } else if (option.name === "config") {
    made = document.createElement("textarea");
    made.rows = 3;
    made.placeholder = "hide.budget=500";
  } else {
    made = document.createElement("input");
    made.type = { switch: "checkbox", whole: "number", number: "number" }[option.kind] ?? "text";
    if (option.kind === "whole") { made.min = "0"; made.step = "1"; }
    if (option.kind === "number") made.step = "any";
    if (option.kind === "pose") made.placeholder = "x, y, yaw";
    if (typeof option.default === "number") made.placeholder = String(option.default);
  }
  made.spellcheck = false;
  made.dataset.option = option.name;
  made.dataset.kind = option.kind;
  return made;
}

// Labelled controls, in a closed section for each group but the first.
export function build(box, options) {
  const groups = new Map();
  for (const option of options.filter((each) => !FILES.includes(each.name))) {
    if (!groups.has(option.group)) {
      const grid = document.createElement("div");
      grid.className = "grid";
      groups.set(option.group, grid);
      if (option.group) {
        const section = document.createElement("details"), title = document.createElement("summary");
        title.textContent = option.group.replace(/ \(exit code .*\)/, "");
        section.append(title, grid);
        box.append(section);
      } else box.append(grid);
    }
    const label = document.createElement("label"), made = control(option);
    const text = option.name.replace("read.", "").replaceAll("_", " ");
    if (option.kind === "switch") { label.className = "check"; label.append(made, ` ${text}`); } else label.append(`${text} `, made);
    const help = document.createElement("small");
    help.className = "quiet";
    help.textContent = option.help.replaceAll("`", "");
    help.id = made.id = `option-${option.name}`;
    help.id += "-help";
    made.setAttribute("aria-describedby", help.id);
    label.append(help);
    groups.get(option.group).append(label, ...(option.name === "config" ? [finder(made)] : []));
  }
}

function value(made) {
  const text = made.value.trim(), name = made.dataset.option;
  if (made.dataset.kind === "switch") return made.checked || null;
  if (!text) return null;
  if (name === "config") return config(text);
  if (made.dataset.kind === "pose") {
    const found = text.split(/[\s,]+/).map(Number);
    if (found.length !== 3 || found.some(Number.isNaN)) throw new SyntaxError(`${name}: three numbers are needed: x, y (metres) and yaw (radians)`);
    return found;
  }
  return made.type === "number" ? Number(text) : text;
}

// What was chosen, as the request has it; what was left alone is left out.
export function chosen(box) {
  const found = {};
  for (const made of box.querySelectorAll("[data-option]")) {
    const now = value(made);
    if (now === null) continue;
    const [first, second] = made.dataset.option.split(".");
    if (second) (found[first] ??= {})[second] = now; else found[first] = now;
  }
  return found;
}
