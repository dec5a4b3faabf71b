// Zoom and pan of a map: wheel, two fingers, buttons and keys zoom, dragging and arrow keys pan.

import { element } from "./dom.js";

const MIN_M = 4;  // least width
const STEP = 1.5;  // zoom factor of a button or key
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };

export class View {
  /** `looked` is called with the visible width, m, whenever it may have changed. */
  constructor(svg, looked) {
    this.svg = svg;
    this.looked = looked;
    this.bounds = null;  // x0, y0, x1, y1 of the whole map, m, y upwards
    this.seen = null;    // centre and width of the visible part; null for the whole map
    this.at = null;      // position of the robot
    this.following = false;
    this.pointers = new Map();
    svg.tabIndex = 0;
    svg.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(event.deltaY * (event.deltaMode ? .05 : .0015)), this.place(event));
    }, { passive: false });
    svg.addEventListener("pointerdown", (event) => {
      if (!event.button) this.pointers.set(event.pointerId, this.place(event));
    });
    svg.addEventListener("pointermove", (event) => this.drag(event));
    for (const end of ["pointerup", "pointercancel"]) {
      svg.addEventListener(end, (event) => this.pointers.delete(event.pointerId));
    }
    svg.addEventListener("keydown", (event) => this.key(event));
    new ResizeObserver(() => this.look()).observe(svg);
  }

  /** Return buttons to zoom. */
  buttons() {
    return [["−", "Zoom out", () => this.zoom(STEP)], ["+", "Zoom in", () => this.zoom(1 / STEP)],
      ["Fit", "Show the whole map", () => this.fit()]].map(([text, title, act]) => {
      const button = Object.assign(element("button", "small", text), { type: "button", title });
      button.setAttribute("aria-label", title);
      button.addEventListener("click", act);
      return button;
    });
  }

  key(event) {
    const by = ARROWS[event.key];
    const width = this.shown().width / 8;
    if (by) this.move(by[0] * width, by[1] * width);
    else if (event.key === "+" || event.key === "=") this.zoom(1 / STEP);
    else if (event.key === "-") this.zoom(STEP);
    else if (event.key === "0") this.fit();
    else return;
    event.preventDefault();
  }

  /** Return the position of an event on the map, m. */
  place(event) {
    const at = new DOMPoint(event.clientX, event.clientY).matrixTransform(this.svg.getScreenCTM().inverse());
    return [at.x, -at.y];
  }

  drag(event) {
    const from = this.pointers.get(event.pointerId);
    if (!from) return;
    if (this.pointers.size === 1 && !this.seen && event.pointerType === "touch") return;  // the page scrolls
    this.svg.setPointerCapture(event.pointerId);
    const to = this.place(event);
    const other = [...this.pointers].find(([id]) => id !== event.pointerId)?.[1];
    if (other) {
      const apart = (one) => Math.hypot(one[0] - other[0], one[1] - other[1]);
      if (apart(to) > 0) this.zoom(apart(from) / apart(to), other);
    } else {
      this.move(from[0] - to[0], from[1] - to[1]);
    }
    this.pointers.set(event.pointerId, this.place(event));
  }

  /** Return centre and width of the visible part, m. */
  shown() {
    const [x0, y0, x1, y1] = this.bounds;
    const seen = this.seen || { x: (x0 + x1) / 2, y: (y0 + y1) / 2, width: x1 - x0 };
    return this.following && this.at ? { ...seen, x: this.at[0], y: this.at[1] } : seen;
  }

  /** Zoom out (factor above 1) or in, around a fixed position. */
  zoom(factor, [x, y] = [this.shown().x, this.shown().y]) {
    const seen = this.shown();
    const whole = this.bounds[2] - this.bounds[0];
    const width = Math.max(Math.min(MIN_M, whole / 8), seen.width * factor);
    if (width >= whole && !this.following) {
      this.fit();
      return;
    }
    const by = Math.min(width, whole) / seen.width;
    this.seen = { x: x + (seen.x - x) * by, y: y + (seen.y - y) * by, width: seen.width * by };
    this.look();
  }

  move(x, y) {
    const { x: atX, y: atY, width } = this.shown();
    const [x0, y0, x1, y1] = this.bounds;
    this.following = false;
    this.seen = { x: Math.min(Math.max(atX + x, x0), x1), y: Math.min(Math.max(atY + y, y0), y1), width };
    this.look();
  }

  fit() {
    this.seen = null;
    this.following = false;
    this.look();
  }

  follow(on, width) {
    this.following = on;
    this.seen = on ? { x: 0, y: 0, ...this.shown(), width: Math.min(width, this.shown().width) } : null;
    this.look();
  }

  look() {
    if (!this.bounds) return;
    const [x0, y0, x1, y1] = this.bounds;
    const { x, y, width } = this.shown();
    const height = width * (y1 - y0) / (x1 - x0);
    this.svg.setAttribute("viewBox", `${x - width / 2} ${-y - height / 2} ${width} ${height}`);
    this.svg.style.touchAction = this.seen || this.following ? "none" : "pan-y";
    this.looked(width, height);
  }
}
