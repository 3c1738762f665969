// Parameters as people type them, `hide.budget=500`: checked against the server's schema, and offered by name.

let known = new Map(); // by name: its schema

export function use(schema, before = "") {
  if (!before) known = new Map();
  for (const [name, each] of Object.entries(schema.properties ?? {})) {
    const whole = before + name;
    if (each.properties) use(each, `${whole}.`); else known.set(whole, each);
  }
}

const low = (schema) => schema.minimum ?? schema.exclusiveMinimum;
const high = (schema) => schema.maximum ?? schema.exclusiveMaximum;
const VAST = 1e9; // a limit this large is none

function range(schema) {
  if (schema.enum) return `one of ${schema.enum.join(", ")}`;
  if (schema.type === "boolean") return "true or false";
  if (schema.type === "array") return "numbers with commas between them";
  const parts = [low(schema) !== undefined && low(schema) > -VAST ? `from ${low(schema)}` : "", high(schema) !== undefined && high(schema) < VAST ? `to ${high(schema)}` : ""];
  return [schema.type === "integer" ? "a whole number" : "a number", ...parts.filter(Boolean)].join(" ");
}

const help = (name) => { const { description, default: usual } = known.get(name); return `${description} ${usual} by default; it must be ${range(known.get(name))}.`; };

function value(name, text) {
  const schema = known.get(name);
  const wrong = () => new SyntaxError(`${name}=${text}: it must be ${range(schema)}`);
  if (schema.type === "boolean") { if (!/^(true|false)$/.test(text)) throw wrong(); return text === "true"; }
  if (schema.type === "string") { if (schema.enum && !schema.enum.includes(text)) throw wrong(); return text; }
  const numbers = text.split(",").map((part) => part.trim() === "" ? NaN : Number(part));
  if (numbers.some(Number.isNaN)) throw wrong();
  if (schema.type === "array") return numbers;
  const [number] = numbers;
  if (numbers.length > 1 || (schema.type === "integer" && !Number.isInteger(number)) || number < low(schema) || number > high(schema)) throw wrong();
  return number;
}

// The name that is most like one that is not known: it ends alike, or holds it.
const similar = (name) => [...known.keys()].find((each) => each.endsWith(`.${name.split(".").at(-1)}`)) ?? [...known.keys()].find((each) => each.includes(name.split(".").at(-1)));

// {"hide": {"budget": 500}} of `hide.budget=500`; several with spaces, or lines, between them. JSON is taken, too.
export function config(text) {
  if (text.trim().startsWith("{")) {
    try { return JSON.parse(text); } catch (error) { throw new SyntaxError(`parameters are not JSON: ${error.message}`); }
  }
  const found = {};
  for (const part of text.split(/\s+/).filter(Boolean)) {
    const [, name, written] = /^([\w.]+)=(.+)$/.exec(part) ?? [];
    if (!name) throw new SyntaxError(`parameters: ${part} is not of the form name=value, such as hide.budget=500`);
    if (!known.has(name)) throw new SyntaxError(`parameters: there is no ${name}${similar(name) ? `; did you mean ${similar(name)}?` : ""}`);
    let into = found;
    const path = name.split("."), last = path.pop();
    for (const key of path) into = into[key] ??= {};
    into[last] = value(name, written);
  }
  return found;
}

// Configurations by name: a line for each, `few: hide.budget=100`; a line without a name is named by what it says.
export function configs(text) {
  if (!text.trim()) return null;
  if (text.trim().startsWith("{")) return Object.fromEntries(Object.entries(config(text)).map(([label, each]) => [label, { config: each }]));
  const found = {};
  for (const line of text.split("\n").map((each) => each.trim()).filter(Boolean)) {
    const [, label = line, written] = /^(?:([^:=]+):)?(.*)$/.exec(line), name = label.trim().replaceAll(/\s+/g, " ");
    if (name in found) throw new SyntaxError(`configurations: ${name} is there twice`);
    found[name] = { config: config(written) };
  }
  return found;
}

// A field that finds parameters by name, shows what each is, and adds it to the text.
export function finder(area) {
  const box = document.createElement("label"), input = document.createElement("input"), list = document.createElement("datalist"), text = document.createElement("small"), add = document.createElement("button"), row = document.createElement("span");
  list.id = `${area.id}-names`;
  list.append(...[...known].map(([name, schema]) => new Option(`${range(schema)}; default ${schema.default}`, name)));
  input.setAttribute("list", list.id);
  input.placeholder = "hide.budget";
  input.spellcheck = false;
  add.type = "button"; add.textContent = "Add"; add.disabled = true;
  text.className = "quiet";
  text.setAttribute("role", "status");
  text.textContent = `${known.size} parameters: type a part of the name.`;
  input.addEventListener("input", () => {
    add.disabled = !known.has(input.value);
    text.textContent = known.has(input.value) ? help(input.value) : `${[...known.keys()].filter((name) => name.includes(input.value)).length} of ${known.size} parameters have this in their name.`;
  });
  const put = () => {
    const { default: usual } = known.get(input.value), before = area.value.replace(/[ \t]+$/, "");
    area.value = `${before}${before && !before.endsWith("\n") ? " " : ""}${input.value}=${usual}`;
    area.focus();
    area.setSelectionRange(area.value.length - String(usual).length, area.value.length);
  };
  add.addEventListener("click", put);
  input.addEventListener("keydown", (event) => {
    if (event.key !== "Enter") return;
    event.preventDefault(); // it would send the form
    if (!add.disabled) put();
  });
  row.className = "row";
  row.append(input, add);
  box.append("Find a parameter ", row, list, text);
  return box;
}
