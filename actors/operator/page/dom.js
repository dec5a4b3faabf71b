// Small helpers for all panels.

export const $ = (id) => document.getElementById(id);

export function element(tag, className, text) {
  const made = document.createElement(tag);
  if (className) made.className = className;
  if (text !== undefined) made.textContent = text;
  return made;
}

const SVG = "http://www.w3.org/2000/svg";

export function svg(tag, attributes, parent, text) {
  const made = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  if (text !== undefined) made.textContent = text;
  if (parent) parent.append(made);
  return made;
}

/** Set a text only if it differs, so that a selection survives and screen readers stay quiet. */
export function say(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

/** Show a state: `where` is an element or its id, `kind` good, warn, bad or nothing. */
export function pill(where, kind, text) {
  const node = typeof where === "string" ? $(where) : where;
  if (node.className !== `pill ${kind}`) node.className = `pill ${kind}`;
  say(node, text);
}

export function clock(seconds) {
  if (!Number.isFinite(seconds)) return "–";
  const tenths = Math.round(Math.max(seconds, 0) * 10);
  const minutes = Math.floor(tenths / 600);
  return `${minutes}:${((tenths - 600 * minutes) / 10).toFixed(1).padStart(4, "0")}`;
}

/** A value of a message as text: a number with four digits, a text unchanged. */
export function figure(value) {
  if (value === null || value === undefined) return "no value";
  if (typeof value !== "number") return String(value);
  return Number.isInteger(value) && Math.abs(value) < 1e6 ? String(value) : String(Number(value.toPrecision(4)));
}

/** Remembers what is shown, so that a part is rebuilt only if its data has changed. */
export class Memory {
  constructor() { this.shown = {}; }

  once(name, value, build) {
    const text = JSON.stringify(value);
    if (this.shown[name] === text) return;
    this.shown[name] = text;
    build();
  }

  forget() { this.shown = {}; }
}
