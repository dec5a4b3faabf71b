// What panels can show of fields of topics, and a stick that says them. A field's section of the picture is named as the field,
// "topic:field", and has its value, whether that is stale, and where the past is shown its time.

import { element, figure, say, svg } from "./dom.js";
import { Stick } from "./stick.js";

const label = (field) => field.slice(field.indexOf(":") + 1);

/** What a field says now, in words; also that it was not heard. */
function now(picture, field, unit = "") {
  const heard = picture[field];
  if (!heard) return "not heard";
  const text = figure(heard.value) + (unit && heard.value !== null ? ` ${unit}` : "");
  return heard.stale ? `${text} (stale)` : text;
}

class Widget {
  constructor(room, page) {
    this.body = room.body;
    this.section = room.section;
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
    this.other = element("li", "other");  // what is not listed
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
    say(this.words, !heard ? "not heard" : heard.stale ? "stale" : "");
    this.words.hidden = !this.words.textContent;
  }
}

const POINTS = 600;

/** What a number was: [seconds, value or null], the oldest first, at most so far back. */
class Past {
  constructor(seconds) {
    this.seconds = seconds;
    this.points = [];
  }

  begin(points) { this.points = points ? [...points] : []; }

  add({ t, value }) {
    if (!Number.isFinite(t)) return;
    const last = this.points[this.points.length - 1];
    if (last && t < last[0]) this.points = [];
    if (last && t - last[0] < this.seconds / POINTS) return;
    this.points.push([t, typeof value === "boolean" ? Number(value) : Number.isFinite(value) && Math.abs(value) < 1e15 ? value : null]);
    if (this.points.length > 2 * POINTS) this.points.splice(0, POINTS);
  }

  since(t) {
    const first = this.points.findIndex((point) => point[0] >= t);
    return first < 0 ? [] : this.points.slice(Math.max(first - 1, 0));
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

const [WIDE, HIGH] = [600, 150];
const REDRAW_MS = 500;  // also without a new value: time goes on

class Plot extends Remembering {
  static kind = "plot";

  keptSeconds() { return this.declared.seconds ?? 60; }

  build() {
    super.build();
    this.drawn = 0;
    const frame = element("div", "plot-frame");
    this.high = element("span", "high quiet");
    this.low = element("span", "low quiet");
    this.canvas = svg("svg", { class: "plot", viewBox: `0 0 ${WIDE} ${HIGH}`, preserveAspectRatio: "none", role: "img",
      "aria-label": `${this.declared.title}, the last ${this.keptSeconds()} seconds; the latest values are listed below` });
    for (const share of [0, .5, 1]) svg("path", { class: "grid", d: `M0 ${share * HIGH}h${WIDE}` }, this.canvas);
    this.lines = this.fields.map((_, i) => svg("path", { class: `series s${i}` }, this.canvas));
    frame.append(this.high, this.low, this.canvas);
    const ends = element("p", "ends quiet");
    ends.append(element("span", "", `−${this.keptSeconds()} s`), element("span", "", "now"));
    const legend = element("ul", "legend");
    legend.setAttribute("aria-label", `${this.declared.title}: latest values`);
    this.values = this.fields.map((field, i) => {
      const line = element("li");
      const sign = svg("svg", { class: "sign", viewBox: "0 0 24 8", "aria-hidden": "true" }, line);
      svg("path", { class: `series s${i}`, d: "M0 4h24" }, sign);
      const value = element("b");
      line.append(element("span", "", label(field)), value);
      line.title = field;
      legend.append(line);
      return value;
    });
    this.body.append(frame, ends, legend);
  }

  show(picture, changed) {
    if (this.fields.some((field) => changed.has(field)) || performance.now() - this.drawn > REDRAW_MS) this.draw(picture);
  }

  draw(picture) {
    this.drawn = performance.now();
    const seconds = this.keptSeconds();
    const series = [...this.past.values()];
    const end = Math.max(picture.time_s ?? -Infinity, ...series.map((past) => past.points[past.points.length - 1]?.[0] ?? -Infinity));
    const shown = series.map((past) => past.since(end - seconds));
    const numbers = shown.flat().map((point) => point[1]).filter((value) => value !== null);
    let low = this.declared.min ?? numbers.reduce((a, b) => Math.min(a, b), Infinity);
    let high = this.declared.max ?? numbers.reduce((a, b) => Math.max(a, b), -Infinity);
    if (!(low < high)) [low, high] = Number.isFinite(low) ? [low - 1, low + 1] : [0, 1];
    const [x, y] = [WIDE / seconds, HIGH / (high - low)];
    shown.forEach((points, i) => {
      let [d, pen] = ["", "M"];
      for (const [t, value] of points) {
        if (value === null) { pen = "M"; continue; }
        d += `${pen}${((t - end + seconds) * x).toFixed(1)} ${((high - value) * y).toFixed(1)}`;
        pen = "L";
      }
      this.lines[i].setAttribute("d", d || "M0 0");
    });
    const unit = this.declared.unit ? ` ${this.declared.unit}` : "";
    say(this.high, numbers.length ? figure(high) + unit : "");
    say(this.low, numbers.length ? figure(low) + unit : "");
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
    this.section.dataset.columns = "2";
    this.section.dataset.grows = "380";
    this.canvas = svg("svg", { class: "place", role: "img", "aria-label": `${this.declared.title}: a map, x to the right and y upwards` });
    this.grid = svg("path", { class: "grid" }, this.canvas);
    this.track = svg("path", { class: "way" }, this.canvas);
    this.robot = svg("path", { class: "robot-mark" }, this.canvas);
    this.words = element("p", "where quiet");
    this.body.append(this.canvas, this.words);
  }

  draw(picture) {
    const [xs, ys] = this.fields.map((field) => this.past.get(field).points);
    const at = new Map(ys);
    const way = xs.filter(([t, x]) => x !== null && Number.isFinite(at.get(t))).map(([t, x]) => [x, at.get(t)]);
    const [x, y, heading] = this.fields.map((field) => picture[field]?.value);
    const known = Number.isFinite(x) && Number.isFinite(y);
    if (known) way.push([x, y]);
    this.look(way);
    this.track.setAttribute("d", way.length ? `M${way.map(([a, b]) => `${a.toFixed(3)} ${(-b).toFixed(3)}`).join("L")}` : "M0 0");
    this.robot.setAttribute("visibility", known ? "visible" : "hidden");
    if (known) {
      const size = this.size / 40;
      const turned = Number.isFinite(heading);
      this.robot.setAttribute("d", turned ? "M1.4 0L-1 .9L-.5 0L-1 -.9Z" : "M1 0A1 1 0 1 1 -1 0A1 1 0 1 1 1 0Z");
      this.robot.setAttribute("transform", `translate(${x} ${-y}) scale(${size}) rotate(${turned ? -heading * 180 / Math.PI : 0})`);
    }
    this.robot.classList.toggle("stale", Boolean(picture[this.fields[0]]?.stale));
    const turn = Number.isFinite(heading) ? `, heading ${(heading * 180 / Math.PI).toFixed(0)}°` : "";
    say(this.words, !known ? "The position is not known."
      : `x ${x.toFixed(2)} m, y ${y.toFixed(2)} m${turn}${picture[this.fields[0]].stale ? " (stale)" : ""}; a square is ${this.step} m wide.`);
  }

  /** Show the extent that was declared, or what holds the way. */
  look(way) {
    let [x0, y0, x1, y1] = this.declared.extent_m || [Infinity, Infinity, -Infinity, -Infinity];
    if (!this.declared.extent_m) {
      for (const [x, y] of way) {
        [x0, y0, x1, y1] = [Math.min(x0, x - MARGIN_M), Math.min(y0, y - MARGIN_M), Math.max(x1, x + MARGIN_M), Math.max(y1, y + MARGIN_M)];
      }
      if (!way.length) [x0, y0, x1, y1] = [-5, -5, 5, 5];
      const short = (x1 - x0) / 2 - (y1 - y0);  // at most twice as wide as high, and never higher than wide
      if (short > 0) [y0, y1] = [y0 - short / 2, y1 + short / 2];
      const thin = (y1 - y0) - (x1 - x0);
      if (thin > 0) [x0, x1] = [x0 - thin / 2, x1 + thin / 2];
    }
    const box = [x0, -y1, x1 - x0, y1 - y0].map((v) => v.toFixed(3)).join(" ");
    this.size = Math.max(x1 - x0, y1 - y0);
    if (box === this.box) return;
    this.box = box;
    this.step = STEPS_M.find((step) => this.size / step <= 16) || Math.ceil(this.size / 16);
    this.canvas.setAttribute("viewBox", box);
    let d = "";
    const over = this.size;  // beyond the extent: the panel may have another shape
    [x0, y0, x1, y1] = [x0 - over, y0 - over, x1 + over, y1 + over];
    for (let x = Math.ceil(x0 / this.step); x * this.step <= x1; x += 1) d += `M${x * this.step} ${-y1}V${-y0}`;
    for (let y = Math.ceil(y0 / this.step); y * this.step <= y1; y += 1) d += `M${x0} ${-y * this.step}H${x1}`;
    this.grid.setAttribute("d", d || "M0 0");
  }
}

export const WIDGETS = Object.fromEntries([Gauge, Plot, Table, States, Text, Place, Stick].map((kind) => [kind.kind, kind]));
