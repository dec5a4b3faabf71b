// The fault tree with its mechanisms as barriers, and the order of recoveries. The HMI computes the
// layout; this module draws it once, and marks detections. No state is shown by colour only: a
// marked box also has a frame and a word.

import { svg, say } from "./dom.js";

const LINE = 14;
const STEM = 78;  // as BARRIER in system.py: the line on which a barrier stands
const PAD = 10;
const path = (points) => `M${points.map(([x, y]) => `${x} ${y}`).join("L")}`;

function box(shape, parent, className) {
  const group = svg("g", { class: className }, parent);
  svg("rect", { class: "box", x: shape.x, y: shape.y, width: shape.width, height: shape.height, rx: 4 }, group);
  const first = shape.y + shape.height / 2 - LINE * shape.lines.length / 2 + 11;
  shape.lines.forEach((line, i) => svg("text", { x: shape.x + shape.width / 2, y: first + LINE * i }, group, line));
  return group;
}

function begin(canvas, drawing) {
  canvas.replaceChildren();
  const [width, height] = [drawing.width + 2 * PAD, drawing.height + 2 * PAD];
  canvas.setAttribute("viewBox", `${-PAD} ${-PAD} ${width} ${height}`);
  canvas.style.setProperty("--natural", `${Math.round(width)}px`);
  canvas.closest(".panel").dataset.columns = Math.min(3, Math.ceil(width / 420));
  svg("title", {}, canvas, drawing.title);
  svg("desc", {}, canvas, drawing.words);
}

export class FaultTree {
  constructor(canvas) {
    this.canvas = canvas;
    this.events = new Map();
    this.lines = [];
  }

  begin(drawing) {
    this.events.clear();
    this.lines = [];
    this.canvas.replaceChildren();
    if (!drawing) return;
    begin(this.canvas, drawing);
    const under = svg("g", {}, this.canvas);
    const arriving = new Map();
    for (const line of drawing.lines) {
      this.lines.push({ ...line, drawn: svg("path", { class: "line", d: path(line.points) }, under) });
      const end = line.points[line.points.length - 1];
      arriving.set(line.lower, [...(arriving.get(line.lower) || []), end]);
    }
    for (const ends of arriving.values()) {  // all inputs of the same box
      if (ends.length > 1) svg("path", { class: "line", d: path(ends) }, under);
    }
    for (const shape of drawing.boxes) this.addEvent(shape, arriving.has(shape.name));
  }

  addEvent(shape, below) {
    const group = svg("g", { class: "event" }, this.canvas);
    const middle = shape.y + shape.height / 2;
    const right = shape.x + shape.width;
    if (below || shape.mechanism) svg("path", { class: "line stem", d: `M${shape.x - (shape.mechanism ? STEM : below ? STEM : 0)} ${middle}H${shape.x}` }, group);
    box(shape, group, shape.gate ? "" : "basic");
    if (shape.gate) this.addGate(shape.gate, right, middle, group);
    else svg("circle", { class: "gate", cx: right + 5, cy: middle, r: 5 }, group);
    const title = svg("title", {}, group);
    const tag = svg("text", { class: "tag", x: shape.x + shape.width / 2, y: shape.y - 3 }, group);
    let barrier = null;
    if (shape.mechanism) {
      const x = shape.x - STEM / 2;
      barrier = svg("g", { class: "barrier" }, group);
      svg("path", { class: "bar", d: `M${x - 4} ${middle - 11}v22M${x + 4} ${middle - 11}v22` }, barrier);
      svg("text", { class: "ftm", x, y: middle - 15 }, barrier, shape.mechanism);
      const short = `${shape.detect} → ${shape.recover}`;
      svg("text", { class: "modules", x, y: middle + 22 }, barrier, short.length > 12 ? `${short.slice(0, 11)}…` : short);
    }
    this.events.set(shape.name, { shape, group, title, tag, barrier });
  }

  addGate(qualifier, x, y, group) {
    const left = x + 6;
    svg("path", { class: "line", d: `M${x} ${y}h6M${left + 20} ${y}h8` }, group);
    const d = qualifier === "&"
      ? `M${left + 22} ${y - 11}H${left + 11}A11 11 0 0 0 ${left + 11} ${y + 11}H${left + 22}Z`
      : `M${left + 24} ${y - 11}Q${left + 8} ${y - 11} ${left} ${y}Q${left + 8} ${y + 11} ${left + 24} ${y + 11}Q${left + 18} ${y} ${left + 24} ${y - 11}Z`;
    svg("path", { class: "gate", d }, group);
    svg("text", { class: "qualifier", x: left + 13, y: y + 3.5 }, group, qualifier);
  }

  /** Mark detected events, the events above them, and the next barriers. */
  show(manager) {
    const status = manager ? manager.value : { active: [], activated: [], detections: [], silent: [] };
    const stale = !manager || manager.stale;
    const reasons = new Map(status.detections.map((d) => [d.name, d]));
    const occurred = new Set();
    const led = new Set();
    const words = [];
    for (const { shape } of this.events.values()) {
      if (!status.active.includes(shape.mechanism)) continue;
      occurred.add(shape.name);
      for (const upper of shape.way) led.add(upper);
    }
    for (const { shape, group, title, tag, barrier } of this.events.values()) {
      const lit = occurred.has(shape.name);
      const ahead = led.has(shape.name) && !lit;
      const silent = shape.detections.some((name) => status.silent.includes(name));
      const running = shape.recoveries.filter((name) => status.activated.includes(name));
      const detected = shape.detections.filter((name) => reasons.get(name)?.active);
      group.setAttribute("class", ["event", lit && "active", ahead && "ahead", silent && "silent",
        lit && running.length && "acting"].filter(Boolean).join(" "));
      say(tag, lit ? (running.length ? `detected · ${running.join(" + ")} runs` : "detected")
        : silent ? "module silent" : ahead && shape.mechanism ? "next barrier" : "");
      const why = detected.map((name) => `${name}: ${reasons.get(name).reason}`).join("; ");
      say(title, [shape.title, barrier && `${shape.mechanism}(${shape.detect}, ${shape.recover})`, tag.textContent, why]
        .filter(Boolean).join(" – "));
      if (lit) words.push(`${shape.mechanism}, ${shape.title}: ${tag.textContent}${why ? ` (${why})` : ""}`);
    }
    for (const line of this.lines) {
      const on = led.has(line.upper) && (occurred.has(line.lower) || (led.has(line.lower) && !this.events.get(line.lower).shape.mechanism));
      line.drawn.classList.toggle("lit", on);
    }
    this.canvas.classList.toggle("stale", stale);
    return stale ? "No message from the manager: the marks may be out of date."
      : words.length ? `Detected: ${words.join(". ")}.` : "Nothing is detected.";
  }
}

export class Order {
  constructor(canvas) {
    this.canvas = canvas;
    this.recoveries = new Map();
  }

  begin(drawing) {
    this.recoveries.clear();
    this.canvas.replaceChildren();
    if (!drawing) return;
    begin(this.canvas, drawing);
    for (const line of drawing.lines) svg("path", { class: "line", d: path(line.points) }, this.canvas);
    for (const shape of drawing.boxes) {
      const group = box(shape, this.canvas, "recovery");
      const title = svg("title", {}, group);
      const tag = svg("text", { class: "tag", x: shape.x + shape.width - 6, y: shape.y + 11 }, group);
      this.recoveries.set(shape.name, { shape, group, title, tag });
    }
  }

  show(manager) {
    const status = manager ? manager.value : { activated: [], latched: [] };
    for (const [name, { shape, group, title, tag }] of this.recoveries) {
      const latched = status.latched.includes(name);
      const running = status.activated.includes(name);
      group.setAttribute("class", `recovery ${latched ? "latched" : running ? "running" : ""}`);
      say(tag, latched ? "latched" : running ? "active" : "");
      say(title, `${name}, ${shape.title}${tag.textContent ? `: ${tag.textContent}` : ""}`);
    }
    this.canvas.classList.toggle("stale", !manager || manager.stale);
  }
}
