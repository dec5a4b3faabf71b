// Where the panels are: side by side without holes, folded and in the order that the operator likes.
//
// The order of the elements is the operator's, and that in which the keyboard goes through them. On
// a wide screen each panel is put where there is room first; what a wide one leaves free is filled
// by a later one that fits, or by making those above it higher. `data-columns` of a panel says how
// wide it wants to be: a number, "most", "all", or "natural" (as its diagram); one with `data-grows`
// can be of any height from so many pixels. What grows by itself moves nothing under a hand that is
// about to press: it waits until the pointer rests or has clicked.

import { $, element } from "./dom.js";

const GAP = 12;
const COLUMN = 340;  // pixels at least
const MOST_COLUMNS = 6;
const SLACK = 24;    // so much higher a place has to be to be better than one further left
const KEPT = "rampart-panels:";
const RESTS_MS = 1000;  // a pointer that has not moved for so long is not on its way to a button

const wanted = (panel, columns, width) => {
  const said = panel.dataset.columns || "1";
  if (said === "all") return columns;
  if (said === "most") return Math.max(2, columns - 2);
  if (said !== "natural") return Number(said) || 1;
  const natural = parseFloat(panel.querySelector(".diagram")?.style.getPropertyValue("--natural")) || 0;
  return Math.max(1, Math.ceil((natural + 32 + GAP) / (width + GAP)));
};

/** Choose column, top and height of each panel; `sizes` has span, height and grows of each. */
export function places(sizes, columns, end) {
  const bottom = Array(columns).fill(0);
  const placed = [];
  const left = sizes.map((size, index) => ({ ...size, index, span: Math.min(size.span, columns) }));
  const put = (one, column) => {
    const top = Math.max(...bottom.slice(column, column + one.span));
    placed.push({ ...one, column, top });
    bottom.fill(top + one.height + GAP, column, column + one.span);
    left.splice(left.indexOf(one), 1);
  };
  while (left.length) {
    const next = left[0];
    let [column, top] = [0, Infinity];
    for (let c = 0; c + next.span <= columns; c += 1) {
      const at = Math.max(...bottom.slice(c, c + next.span));
      if (at < top - SLACK) [column, top] = [c, at];
    }
    const filler = holes(bottom, column, next.span, top)
      .map((hole) => [left.slice(1).find((one) => one.span <= hole.span && one.height + GAP <= hole.height), hole.column])
      .find(([one]) => one);
    if (filler) put(...filler);
    else put(next, column);
  }
  fill(placed, Math.max(end, ...bottom.map((b) => b - GAP)));
  return placed.sort((a, b) => a.index - b.index);
}

/** What would stay free above a panel: runs of columns that end at the same height. */
function holes(bottom, column, span, top) {
  const found = [];
  for (let c = column; c < column + span; c += 1) {
    const last = found[found.length - 1];
    if (last && bottom[c] === bottom[c - 1]) last.span += 1;
    else found.push({ column: c, span: 1, height: top - bottom[c] });
  }
  return found.filter((hole) => hole.height > GAP);
}

/** Give away what is free below each panel: to it, or to one above it that can use it. */
function fill(placed, end) {
  const beside = (a, b) => a.column < b.column + b.span && b.column < a.column + a.span;
  for (const one of [...placed].sort((a, b) => a.top - b.top)) {
    const below = placed.filter((other) => other.top > one.top && beside(one, other));
    const free = Math.min(end + GAP, ...below.map((other) => other.top)) - GAP - one.top - one.height;
    if (free <= 0) continue;
    const stack = [one];
    while (!stack[0].grows) {
      const above = placed.find((other) => other.column === one.column && other.span === one.span
        && Math.abs(other.top + other.height + GAP - stack[0].top) < 1);
      if (!above) break;
      stack.unshift(above);
    }
    const heir = stack[0].grows ? stack[0] : one;
    heir.height += free;
    for (const lower of stack.slice(stack.indexOf(heir) + 1)) lower.top += free;
  }
}

/** Say how wide panels may be that have nothing at their right, those first that are of any height. */
export function widened(placed, columns) {
  const wide = placed.map((one) => ({ ...one }));
  const taken = (one, column) => wide.some((other) => other !== one && other.column <= column
    && column < other.column + other.span && other.top < one.top + one.height && one.top < other.top + other.height);
  for (const one of [...wide].sort((a, b) => b.grows - a.grows || b.top - a.top || b.column - a.column)) {
    while (one.column + one.span < columns && !taken(one, one.column + one.span)) one.span += 1;
  }
  return wide.map((one) => one.span);
}

export class Arrangement {
  constructor(main) {
    this.main = main;
    this.key = null;
    this.delivered = [];
    this.frame = 0;
    this.pressed = false;
    this.restsAt = 0;
    this.later = 0;
    this.watch = new ResizeObserver(() => this.grown());
    this.watch.observe(main);
    addEventListener("resize", () => this.soon());
    this.mindTheHand();
    for (const panel of [...main.children]) this.adopt(panel);
    $("arrange-reset").addEventListener("click", () => this.reset());
  }

  get panels() { return [...this.main.children]; }

  /** Give a panel its tools; what stands below its heading can be folded away. */
  adopt(panel) {
    const name = panel.dataset.name;
    const head = element("div", "head");
    const inside = element("div", "inside");
    const title = panel.firstElementChild;
    head.append(title);
    inside.append(...[...panel.childNodes].filter((node) => node !== head));
    panel.append(head, inside);
    const move = this.tool("move", "⠿", `Move ${name}: drag, or use the arrow keys`);
    const fold = this.tool("fold", "▾", `Fold ${name}`);
    fold.setAttribute("aria-expanded", "true");
    fold.addEventListener("click", () => {
      this.fold(panel, !panel.classList.contains("folded"));
      this.keep();
    });
    move.addEventListener("keydown", (event) => this.step(event, panel, move));
    move.addEventListener("pointerdown", (event) => this.drag(event, panel));
    head.append(move, fold);
    this.watch.observe(inside);
    this.watch.observe(head);
  }

  tool(kind, sign, label) {
    const made = element("button", `tool ${kind}`, sign);
    made.type = "button";
    made.title = label;
    made.setAttribute("aria-label", label);
    return made;
  }

  fold(panel, folded) {
    const button = panel.querySelector(".tool.fold");
    panel.classList.toggle("folded", folded);
    button.setAttribute("aria-expanded", String(!folded));
    button.textContent = folded ? "▸" : "▾";
    this.soon();
  }

  step(event, panel, move) {
    const forward = { ArrowRight: true, ArrowDown: true, ArrowLeft: false, ArrowUp: false }[event.key];
    if (forward === undefined) return;
    event.preventDefault();
    const shown = this.panels.filter((one) => !one.hidden);
    const other = shown[shown.indexOf(panel) + (forward ? 1 : -1)];
    if (!other) return;
    this.put(panel, other, forward);
    move.focus();
    const place = this.panels.filter((one) => !one.hidden).indexOf(panel) + 1;
    $("arrange-said").textContent = `${panel.dataset.name}: place ${place} of ${shown.length}`;
  }

  drag(event, panel) {
    event.preventDefault();
    const moved = ({ clientX, clientY }) => {
      const other = document.elementFromPoint(clientX, clientY)?.closest(".panel");
      if (!other || other === panel || other.parentElement !== this.main || other === this.passed) return;
      this.passed = other;  // until the pointer has left it: what was moved may lie under it again
      this.put(panel, other, this.panels.indexOf(other) > this.panels.indexOf(panel));
    };
    const left = ({ target }) => { if (target.closest?.(".panel") !== this.passed) this.passed = null; };
    const end = new AbortController();
    panel.classList.add("dragged");
    addEventListener("pointermove", (moving) => { left(moving); moved(moving); }, { signal: end.signal });
    for (const over of ["pointerup", "pointercancel", "blur"]) {
      addEventListener(over, () => { panel.classList.remove("dragged"); end.abort(); }, { signal: end.signal });
    }
  }

  put(panel, other, after) {
    if (after) other.after(panel);
    else other.before(panel);
    this.keep();
    this.layOut();
  }

  // ---- what is kept ------------------------------------------------------------------------------

  /** Begin with the panels of a system, in the order that was kept for it. */
  begin(system) {
    this.key = KEPT + system;
    this.delivered = this.panels.map((panel) => panel.dataset.name);
    this.apply(this.kept());
  }

  kept() {
    try {
      const { order, folded } = JSON.parse(localStorage.getItem(this.key));
      const names = (list) => (Array.isArray(list) ? list.filter((name) => typeof name === "string") : []);
      return { order: names(order), folded: names(folded) };
    } catch {
      return { order: [], folded: [] };  // nothing, somebody else's, or not permitted
    }
  }

  apply({ order, folded }) {
    const there = new Map(this.panels.map((panel) => [panel.dataset.name, panel]));
    const known = [...new Set(order)].filter((name) => there.has(name));
    const moved = new Set(known);
    const wishes = this.delivered.map((name) => (moved.has(name) ? known.shift() : name));
    if (wishes.some((name, i) => this.panels[i] !== there.get(name))) {
      this.main.append(...wishes.map((name) => there.get(name)));
    }
    for (const [name, panel] of there) this.fold(panel, folded.includes(name));
    this.offerReset();
  }

  keep() {
    const order = this.panels.map((panel) => panel.dataset.name);
    const folded = this.panels.filter((panel) => panel.classList.contains("folded")).map((panel) => panel.dataset.name);
    try {
      localStorage.setItem(this.key, JSON.stringify({ order, folded }));
    } catch { /* then it holds until the page is closed */ }
    this.offerReset();
  }

  offerReset() {
    $("arrange-reset").hidden = this.panels.every((panel, i) => panel.dataset.name === this.delivered[i]
      && !panel.classList.contains("folded"));
  }

  reset() {
    this.apply({ order: this.delivered, folded: [] });
    this.keep();
  }

  // ---- laying out --------------------------------------------------------------------------------

  mindTheHand() {
    const aims = () => { this.restsAt = performance.now() + RESTS_MS; };
    this.main.addEventListener("pointermove", aims);
    this.main.addEventListener("pointerdown", () => { this.pressed = true; });
    for (const over of ["pointerup", "pointercancel", "blur"]) {
      addEventListener(over, () => { this.pressed = false; this.restsAt = 0; });
    }
  }

  /** Lay out what has grown, but not while a pointer is pressed or on its way. */
  grown() {
    const wait = this.pressed ? RESTS_MS : this.restsAt - performance.now();
    if (wait <= 0) this.soon();
    else this.later ||= setTimeout(() => { this.later = 0; this.grown(); }, wait);
  }

  soon() {
    if (!this.frame) this.frame = requestAnimationFrame(() => { this.frame = 0; this.layOut(); });
  }

  layOut() {
    const { main } = this;
    const style = getComputedStyle(main);
    const [left, top] = [parseFloat(style.paddingLeft), parseFloat(style.paddingTop)];
    const room = main.clientWidth - left - parseFloat(style.paddingRight);
    const columns = Math.max(1, Math.min(MOST_COLUMNS, Math.floor((room + GAP) / (COLUMN + GAP))));
    const shown = this.panels.filter((panel) => !panel.hidden);
    main.classList.toggle("placed", columns > 1);
    if (columns === 1) {
      for (const panel of this.panels) panel.removeAttribute("style");
      main.style.height = "";
      return;
    }
    const width = (room - GAP * (columns - 1)) / columns;
    const end = innerHeight - main.getBoundingClientRect().top - scrollY - top - parseFloat(style.paddingBottom);
    const place = (spans) => {
      shown.forEach((panel, i) => { panel.style.width = `${spans[i] * (width + GAP) - GAP}px`; });
      return places(shown.map((panel, i) => this.size(panel, spans[i])), columns, end);
    };
    let placed = place(shown.map((panel) => Math.min(columns, wanted(panel, columns, width))));
    const spans = widened(placed, columns);
    if (spans.some((span, i) => span !== placed[i].span)) placed = place(spans);  // their heights are others then
    placed.forEach((at, i) => Object.assign(shown[i].style, {
      left: `${left + at.column * (width + GAP)}px`, top: `${top + at.top}px`, height: `${at.height}px` }));
    const last = Math.max(0, ...placed.map((at) => at.top + at.height));
    main.style.height = `${top + last + parseFloat(style.paddingBottom)}px`;
  }

  size(panel, span) {
    const [head, inside] = panel.children;
    const chrome = head.offsetTop + head.offsetHeight + 12;  // and its padding at the bottom
    if (panel.classList.contains("folded")) return { span, height: chrome, grows: false };
    if (panel.dataset.grows) return { span, height: Number(panel.dataset.grows), grows: true };
    return { span, height: Math.ceil(inside.offsetTop + inside.offsetHeight + 13), grows: false };
  }
}
