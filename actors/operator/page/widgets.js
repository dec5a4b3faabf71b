// Widgets that show fields of topics. The section of a field has its name, "topic:field", with its
// value, whether that is stale, and its time if a widget shows the past.

import { clock, element, figure, say, svg } from "./dom.js";
import { Stick } from "./stick.js";
import { View } from "./view.js";

const label = (field) => field.slice(field.indexOf(":") + 1);

/** The present value of a field as text. */
function now(picture, field, unit = "") {
  const heard = picture[field];
  if (!heard) return "no data";
  const text = figure(heard.value) + (unit && heard.value !== null ? ` ${unit}` : "");
  return heard.stale ? `${text} (stale)` : text;
}

class Widget {
  constructor(room, page) {
    this.body = room.body;
    this.section = room.section;
    this.title = room.title;
    this.declared = page.declared;
    this.fields = [].concat(this.declared[this.constructor.kind]);
    this.build();
  }

  begin() { this.show({}, new Set(this.fields)); }

  show(picture, changed) {
    if (this.fields.some((field) => changed.has(field))) this.draw(picture);
  }
}

class Gauge extends Widget {
  static kind = "gauge";

  build() {
    this.min = this.declared.min ?? 0;
    this.max = this.declared.max ?? 1;
    this.text = element("p", "figure");
    this.bar = element("div", "gauge");
    this.bar.setAttribute("role", "meter");
    this.bar.setAttribute("aria-label", this.declared.title);
    this.bar.setAttribute("aria-valuemin", this.min);
    this.bar.setAttribute("aria-valuemax", this.max);
    const ends = element("p", "ends quiet");
    ends.append(element("span", "", figure(this.min)), element("span", "", label(this.fields[0])),
      element("span", "", figure(this.max)));
    this.body.append(this.text, this.bar, ends);
  }

  draw(picture) {
    const [field] = this.fields;
    const value = picture[field]?.value;
    const known = Number.isFinite(value);
    const share = known ? (value - this.min) / (this.max - this.min) : 0;
    say(this.text, now(picture, field, this.declared.unit));
    this.text.classList.toggle("stale", !known || picture[field].stale);
    this.bar.classList.toggle("beyond", share < 0 || share > 1);
    this.bar.style.setProperty("--share", Math.min(Math.max(share, 0), 1));
    this.bar.setAttribute("aria-valuenow", known ? value : this.min);
    this.bar.setAttribute("aria-valuetext", this.text.textContent);
  }
}

class Text extends Widget {
  static kind = "text";

  build() {
    this.text = element("p", "figure");
    this.body.append(this.text);
  }

  draw(picture) {
    const [field] = this.fields;
    say(this.text, now(picture, field, this.declared.unit));
    this.text.classList.toggle("stale", !picture[field] || picture[field].stale);
    this.text.classList.toggle("long", this.text.textContent.length > 24);
  }
}

class Table extends Widget {
  static kind = "table";

  build() {
    const table = element("table");
    const body = element("tbody");
    table.append(element("caption", "unseen", `${this.declared.title}: fields and their latest values`), body);
    this.cells = this.fields.map((field) => {
      const row = element("tr");
      const name = element("th", "", label(field));
      name.scope = "row";
      name.title = field;
      const cell = element("td", "num value");
      row.append(name, cell);
      body.append(row);
      return cell;
    });
    this.body.append(table);
  }

  draw(picture) {
    this.fields.forEach((field, i) => {
      say(this.cells[i], now(picture, field));
      this.cells[i].classList.toggle("stale", !picture[field] || picture[field].stale);
    });
  }
}

class States extends Widget {
  static kind = "states";

  build() {
    this.list = element("ol", "states");
    this.list.setAttribute("aria-label", this.declared.title);
    this.items = (this.declared.of || []).map((state) => element("li", "", state));
    this.other = element("li", "other");  // a state that is not listed
    this.list.append(...this.items, this.other);
    this.words = element("p", "quiet");
    this.body.append(this.list, this.words);
  }

  draw(picture) {
    const heard = picture[this.fields[0]];
    const state = heard ? figure(heard.value) : "";
    const listed = this.items.find((item) => item.textContent === state);
    for (const item of [...this.items, this.other]) {
      const on = Boolean(heard) && item === (listed || this.other);
      item.classList.toggle("now", on);
      if (on) item.setAttribute("aria-current", "true");
      else item.removeAttribute("aria-current");
    }
    say(this.other, listed ? "" : state);
    this.other.hidden = !heard || Boolean(listed);
    this.list.classList.toggle("stale", !heard || heard.stale);
    say(this.words, !heard ? "no data" : heard.stale ? "stale" : "");
    this.words.hidden = !this.words.textContent;
  }
}

const POINTS = 600;

/** The past of a number: [seconds, value or null], the oldest first, over a number of seconds. */
class Past {
  constructor(seconds) {
    this.seconds = seconds;
    this.points = [];
  }

  begin(points) { this.points = [...points || []]; }

  add({ t, value }) {
    const last = this.points.at(-1)?.[0] ?? -Infinity;
    if (!Number.isFinite(t) || (t >= last && t - last < this.seconds / POINTS)) return;
    if (t < last) this.points = [];  // another run
    const number = Number(value);
    this.points.push([t, value !== null && Math.abs(number) < 1e15 ? number : null]);
    if (this.points.length > 2 * POINTS) this.points = this.points.slice(-POINTS);
  }
}

class Remembering extends Widget {
  build() {
    this.past = new Map(this.fields.map((field) => [field, new Past(this.keptSeconds())]));
  }

  begin(hello) {
    for (const [field, past] of this.past) past.begin(hello.past[field]);
    this.draw({});
  }

  take(state) {
    for (const [field, past] of this.past) if (state[field]) past.add(state[field]);
  }
}

const REDRAW_MS = 500;  // without a new value, because time goes on
const HEIGHT = 180;
const DASHES = [[], [7, 3], [2, 3], [9, 3, 2, 3], [14, 2], [4, 4], [12, 4], [1, 4]];

class Plot extends Remembering {
  static kind = "plot";

  keptSeconds() { return this.declared.seconds ?? 60; }

  build() {
    super.build();
    this.drawn = 0;
    this.end = 0;
    const frame = element("div", "plot");
    frame.setAttribute("role", "img");
    frame.setAttribute("aria-label", `${this.declared.title}, the last ${this.keptSeconds()} seconds; the latest values are listed below`);
    const legend = element("ul", "legend");
    legend.setAttribute("aria-label", `${this.declared.title}: latest values`);
    this.values = this.fields.map((field, i) => {
      const line = Object.assign(element("li"), { title: field });
      const sign = svg("svg", { width: 24, height: 4, "aria-hidden": "true" }, line);
      svg("path", { d: "M0 2h24", stroke: `var(--s${i})`, "stroke-width": 2.5, "stroke-dasharray": DASHES[i].join(" ") }, sign);
      const value = element("b");
      line.append(element("span", "", label(field)), value);
      legend.append(line);
      return value;
    });
    this.body.append(frame, legend);
    const colour = (name) => () => getComputedStyle(frame).getPropertyValue(name);
    const axis = { stroke: colour("--quiet"), grid: { stroke: colour("--rule"), width: 1 }, ticks: { show: false }, font: "11px system-ui, sans-serif" };
    this.chart = new uPlot({
      width: 300, height: HEIGHT, legend: { show: false }, cursor: { show: false },
      scales: { x: { time: false, range: () => [this.end - this.keptSeconds(), this.end] }, y: { range: (_, low, high) => this.range(low, high) } },
      axes: [{ ...axis, size: 26, values: (_, ticks) => ticks.map((t) => (t < 0 ? "" : clock(t).replace(".0", ""))) }, { ...axis, size: 52, values: (_, ticks) => ticks.map(figure) }],
      series: [{}, ...this.fields.map((_, i) => ({ stroke: colour(`--s${i}`), width: 1.8, dash: DASHES[i], points: { show: false } }))],
    }, [[], ...this.fields.map(() => [])], frame);
    new ResizeObserver(() => this.chart.setSize({ width: frame.clientWidth, height: HEIGHT })).observe(frame);
  }

  range(low, high) {
    const [least, most] = [this.declared.min ?? low ?? 0, this.declared.max ?? high ?? 1];
    return least < most ? [least, most] : [least - 1, least + 1];
  }

  show(picture, changed) {
    if (this.fields.some((field) => changed.has(field)) || performance.now() - this.drawn > REDRAW_MS) this.draw(picture);
  }

  draw(picture) {
    this.drawn = performance.now();
    const series = [...this.past.values()].map(({ points }) => points);
    this.end = Math.max(picture.time_s ?? 0, ...series.map((points) => points.at(-1)?.[0] ?? 0));
    this.chart.setData(uPlot.join(series.map((points) => [points.map(([t]) => t), points.map(([, value]) => value)])));
    this.fields.forEach((field, i) => say(this.values[i], now(picture, field, this.declared.unit)));
  }
}

const MARGIN_M = 2;
const STEPS_M = [.1, .5, 1, 2, 5, 10, 50, 100, 500, 1000];

class Place extends Remembering {
  static kind = "map";

  keptSeconds() { return 600; }

  build() {
    super.build();
    this.section.dataset.columns = 2;
    this.canvas = svg("svg", { class: "place", role: "img", "aria-label": `${this.declared.title}: a map, x to the right and y upwards; arrows move it, plus and minus zoom, 0 shows all` });
    this.grid = svg("path", { class: "grid" }, this.canvas);
    this.track = svg("path", { class: "way" }, this.canvas);
    this.robot = svg("path", { class: "robot-mark" }, this.canvas);
    this.words = element("p", "where quiet");
    this.view = new View(this.canvas, (width) => this.scale(width));
    this.title.append(element("span", "grow"), ...this.view.buttons());
    this.body.append(this.canvas, this.words);
  }

  draw(picture) {
    const [xs, ys] = this.fields.map((field) => this.past.get(field).points);
    const at = new Map(ys);
    const way = xs.filter(([t, x]) => x !== null && Number.isFinite(at.get(t))).map(([t, x]) => [x, at.get(t)]);
    const [x, y, heading] = this.fields.map((field) => picture[field]?.value);
    const known = Number.isFinite(x) && Number.isFinite(y);
    if (known) way.push([x, y]);
    this.track.setAttribute("d", way.length ? `M${way.map(([a, b]) => `${a.toFixed(3)} ${(-b).toFixed(3)}`).join("L")}` : "M0 0");
    this.robot.setAttribute("visibility", known ? "visible" : "hidden");
    const turned = Number.isFinite(heading);
    const degrees = turned ? heading * 180 / Math.PI : 0;
    this.robot.setAttribute("d", turned ? "M1.4 0L-1 .9L-.5 0L-1 -.9Z" : "M1 0A1 1 0 1 1 -1 0A1 1 0 1 1 1 0Z");
    this.mark = known ? `translate(${x} ${-y}) rotate(${-degrees})` : "";
    const stale = Boolean(picture[this.fields[0]]?.stale);
    this.robot.classList.toggle("stale", stale);
    this.view.bounds = this.declared.extent_m || extent(way);
    this.view.look();
    say(this.words, known ? `x ${x.toFixed(2)} m, y ${y.toFixed(2)} m${turned ? `, heading ${degrees.toFixed(0)}°` : ""}${stale ? " (stale)" : ""}; a square is ${this.step} m wide.`
      : "The position is not known.");
  }

  /** Draw the grid for the visible part of the map, and the robot at a constant size. */
  scale(width) {
    const { x, y } = this.view.shown();
    const step = STEPS_M.find((each) => width / each <= 16) || Math.ceil(width / 16);
    const lines = [...Array(2 * Math.ceil(width / step) + 1).keys()].map((i) => i * step - width);
    const [left, top] = [Math.floor(x / step) * step, Math.floor(y / step) * step];
    this.step = step;
    this.robot.setAttribute("transform", `${this.mark} scale(${width / 40})`);
    this.grid.setAttribute("d", lines.map((d) => `M${left + d} ${-top - width}v${2 * width}M${left - width} ${-top + d}h${2 * width}`).join(""));
  }
}

/** Return the extent around a track: at most twice as wide as high, and not higher than wide. */
function extent(way) {
  if (!way.length) return [-5, -5, 5, 5];
  const [xs, ys] = [0, 1].map((axis) => way.map((point) => point[axis]));
  const [x0, x1, y0, y1] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
  const [across, up] = [x1 - x0 + 2 * MARGIN_M, y1 - y0 + 2 * MARGIN_M];
  const height = Math.max(up, across / 2) / 2;
  const width = Math.max(across, 2 * height) / 2;
  const [x, y] = [(x0 + x1) / 2, (y0 + y1) / 2];
  return [x - width, y - height, x + width, y + height];
}

export const WIDGETS = Object.fromEntries([Gauge, Plot, Table, States, Text, Place, Stick].map((kind) => [kind.kind, kind]));
