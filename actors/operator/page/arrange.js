// Layout of the panels: a dense CSS grid, where each panel has to span a number of small rows. The
// operator orders the elements, and the keyboard visits them in this order. The browser remembers
// order and folded panels for each system.

import { $, element } from "./dom.js";

const GAP = 12;
const COLUMN = 340;  // pixels at least
const ROW = 4;       // as in style.css
const KEPT = "rampart-panels:";
const ARROWS = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 };

const strings = (list) => (Array.isArray(list) ? list.filter((one) => typeof one === "string") : []);

export class Arrangement {
  constructor(main) {
    this.main = main;
    this.key = null;
    this.delivered = [];
    this.watch = new ResizeObserver(() => this.layOut());
    this.watch.observe(main);
    addEventListener("pointerup", () => setTimeout(() => this.layOut()));
    for (const panel of this.panels) this.adopt(panel);
    $("arrange-reset").addEventListener("click", () => {
      this.arrange([], []);
      this.keep();
    });
  }

  get panels() { return [...this.main.children]; }

  /** Add the handle that moves a panel. */
  adopt(panel) {
    const { name } = panel.dataset;
    const handle = Object.assign(element("button", "tool", "⠿"), { type: "button", title: `Move ${name}: drag, or use the arrow keys` });
    handle.setAttribute("aria-label", handle.title);
    handle.addEventListener("keydown", (event) => this.step(event, panel, handle));
    handle.addEventListener("pointerdown", (event) => {
      event.preventDefault();
      handle.setPointerCapture(event.pointerId);
      panel.classList.add("dragged");
    });
    handle.addEventListener("lostpointercapture", ({ clientX, clientY }) => {
      panel.classList.remove("dragged");
      const other = document.elementFromPoint(clientX, clientY)?.closest("main > .panel");
      if (other && other !== panel) this.move(panel, other);
    });
    panel.firstElementChild.append(handle);
    panel.addEventListener("toggle", () => this.keep());
    this.watch.observe(panel);
  }

  step(event, panel, handle) {
    if (!(event.key in ARROWS)) return;
    event.preventDefault();
    const shown = this.panels.filter((each) => !each.hidden);
    const other = shown[shown.indexOf(panel) + ARROWS[event.key]];
    if (!other) return;
    this.move(panel, other);
    handle.focus();
    $("arrange-said").textContent = `${panel.dataset.name}: place ${shown.indexOf(other) + 1} of ${shown.length}`;
  }

  /** Move a panel to the place of another one. */
  move(panel, other) {
    const { panels } = this;
    if (panels.indexOf(panel) < panels.indexOf(other)) other.after(panel);
    else other.before(panel);
    this.keep();
  }

  /** Begin with the panels of a system, in the remembered order. */
  begin(system) {
    this.key = KEPT + system;
    this.delivered = this.panels;
    let kept = null;
    try {
      kept = JSON.parse(localStorage.getItem(this.key));
    } catch { /* default order */ }
    this.arrange(strings(kept?.order), strings(kept?.folded));
  }

  arrange(order, folded) {
    const place = new Map(order.map((name, i) => [name, i]));
    const at = (panel) => place.get(panel.dataset.name) ?? order.length;
    this.main.append(...[...this.delivered].sort((a, b) => at(a) - at(b)));
    for (const panel of this.panels) panel.open = !folded.includes(panel.dataset.name);
    this.layOut();
  }

  keep() {
    const { panels } = this;
    const folded = panels.filter((panel) => !panel.open);
    $("arrange-reset").hidden = !folded.length && panels.every((panel, i) => panel === this.delivered[i]);
    const names = (list) => list.map((panel) => panel.dataset.name);
    try {
      localStorage.setItem(this.key, JSON.stringify({ order: names(panels), folded: names(folded) }));
    } catch { /* kept only until the page is closed */ }
  }

  /** Set the rows of each panel from its height; nothing moves while a pointer is pressed. */
  layOut() {
    if (this.main.matches(":active")) return;
    const { paddingLeft, paddingRight } = getComputedStyle(this.main);
    const room = this.main.clientWidth - parseFloat(paddingLeft) - parseFloat(paddingRight);
    const columns = Math.max(1, Math.floor((room + GAP) / (COLUMN + GAP)));
    this.main.style.setProperty("--columns", columns);
    for (const panel of this.panels) panel.style.gridColumnEnd = `span ${Math.min(columns, panel.dataset.columns || 1)}`;
    const heights = this.panels.map((panel) => panel.offsetHeight);
    this.panels.forEach((panel, i) => { panel.style.gridRowEnd = `span ${Math.ceil((heights[i] + GAP) / ROW)}`; });
  }
}
