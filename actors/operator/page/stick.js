// A stick: arrow keys or WASD, a pad to drag, a gamepad. Each has its own dead-man function.
//
// While the stick is held, its position is sent 20 times a second with the newest ticket of the HMI,
// which decides who drives; silence counts as release. The end of the hold (key up, pointer up,
// focus lost, tab hidden, page closed) is sent at once.

import { element, pill, say } from "./dom.js";

const PERIOD_MS = 50;
const DEAD_ZONE = .12;
const SHOULDERS = [4, 5];  // buttons of a standard gamepad: either is the dead man
const KEYS = {
  ArrowUp: [1, 0], KeyW: [1, 0], ArrowDown: [-1, 0], KeyS: [-1, 0],
  ArrowLeft: [0, 1], KeyA: [0, 1], ArrowRight: [0, -1], KeyD: [0, -1],
};

const clip = (value) => Math.min(Math.max(value, -1), 1);

export class Stick {
  static kind = "stick";

  constructor(room, page) {
    this.visitor = page;
    this.panel = page.declared.title;
    this.axes = page.declared.stick.length;  // forward alone, or left as well
    this.gamepads = false;  // a gamepad is for the first stick of a page
    this.armed = false;     // whether the gamepad has been at rest in this window
    this.keys = new Set();
    this.dragged = null;
    this.timer = 0;         // of a hold
    this.since = 0;
    this.drives = false;
    this.text = "";
    this.ticket = 0;
    this.page = null;       // number of this page; null while not connected
    this.status = null;
    this.build(room);
    this.listen();
  }

  build(room) {
    const keys = this.axes > 1 ? "arrow keys or W A S D" : "up or down key, W or S";
    room.section.classList.add("operate");
    this.state = element("span", "pill");
    const state = element("span", "stick-state");
    state.append(this.state);
    room.title.append(" ", state);
    this.pad = element("div", this.axes > 1 ? "stick" : "stick upright");
    this.pad.tabIndex = 0;
    this.pad.setAttribute("role", "application");
    this.pad.setAttribute("aria-label", `Stick: hold the ${keys} to drive`);
    this.knob = element("div", "stick-knob");
    this.pad.append(this.knob);
    const speed = element("label", "", "Speed ");
    this.share = Object.assign(element("input"), { type: "range", min: 10, max: 100, step: 10, value: 50 });
    speed.append(this.share);
    this.how = Object.assign(element("p", "quiet", `Drag the stick, or click it and hold the ${keys}. Letting go stops.`), { id: `${room.title.id}-how` });
    this.words = Object.assign(element("p", "stick-text"), { id: `${room.title.id}-text`, role: "status" });
    this.pad.setAttribute("aria-describedby", `${this.how.id} ${this.words.id}`);
    const words = element("div", "stick-words");
    words.append(this.how, speed, this.words);
    this.row = element("div", "stick-row");
    this.row.append(this.pad, words);
    room.body.append(this.row);
  }

  listen() {
    this.pad.addEventListener("keydown", (event) => this.key(event, true));
    this.pad.addEventListener("keyup", (event) => this.key(event, false));
    this.pad.addEventListener("blur", () => this.letGo());
    this.pad.addEventListener("pointerdown", (event) => {
      this.pad.setPointerCapture(event.pointerId);
      this.drag(event);
    });
    this.pad.addEventListener("pointermove", (event) => { if (this.dragged) this.drag(event); });
    for (const end of ["pointerup", "pointercancel", "lostpointercapture"]) {
      this.pad.addEventListener(end, () => { this.dragged = null; this.update(); });
    }
    this.pad.addEventListener("contextmenu", (event) => event.preventDefault());  // a long touch
    addEventListener("blur", () => this.letGo());
    addEventListener("pagehide", () => this.letGo());
    document.addEventListener("visibilitychange", () => { if (document.hidden) this.letGo(); });
    addEventListener("gamepadconnected", () => {
      this.armed = false;  // plugging in moves nothing
      this.update();
      this.polling ||= setInterval(() => this.update(), PERIOD_MS);
    });
    addEventListener("gamepaddisconnected", () => this.update());
  }

  key(event, down) {
    if (event.ctrlKey || event.altKey || event.metaKey) {
      this.letGo();  // with one of these a browser need not report the release of other keys
      return;
    }
    if (!KEYS[event.code]?.slice(0, this.axes).some(Boolean)) return;
    event.preventDefault();  // do not scroll
    if (down && event.repeat && !this.keys.has(event.code)) return;  // held since before the focus: press again
    if (down) this.keys.add(event.code); else this.keys.delete(event.code);
    this.update();
  }

  drag(event) {
    const box = this.pad.getBoundingClientRect();
    const radius = box.width / 2;
    const x = this.axes > 1 ? (event.clientX - box.left) / radius - 1 : 0;
    const y = (event.clientY - box.top) / radius - 1;
    const length = Math.max(Math.hypot(x, y), 1);
    this.dragged = [-y / length, -x / length];
    this.update();
  }

  /** Position of the gamepad with a held shoulder button; a press in another window is ignored. */
  gamepad() {
    const pads = this.gamepads && navigator.getGamepads ? [...navigator.getGamepads()] : [];
    const pad = pads.find((each) => each?.connected && SHOULDERS.some((i) => each.buttons[i]?.pressed));
    if (!pad || !document.hasFocus()) this.armed = !pad;
    if (!pad || !this.armed) return null;
    const axis = (i) => (Math.abs(pad.axes[i] || 0) < DEAD_ZONE ? 0 : -pad.axes[i]);
    return [axis(1), this.axes > 1 ? axis(0) : 0];
  }

  /** Position of the stick: [forward, left] in [-1, 1], or null if it is not held. */
  position() {
    const pad = this.gamepad();
    if (this.visitor.barred("stick")) return null;
    const share = this.share.valueAsNumber / 100;
    let at = this.dragged || pad;
    if (!at && this.keys.size) at = [0, 1].map((axis) => [...this.keys].reduce((sum, code) => sum + KEYS[code][axis], 0));
    return at && at.map((value) => clip(value) * share);
  }

  /** Start or stop reporting after a press or release. */
  update() {
    const at = this.position();
    if (at && !this.timer) {
      this.since = performance.now();
      this.text = "";
      this.timer = setInterval(() => this.report(), PERIOD_MS);
      this.report();
    } else if (!at && this.timer) {
      clearInterval(this.timer);
      this.timer = 0;
      this.drives = false;
      this.report();
    }
    this.draw();
  }

  /** Release everything: a page without focus may not receive the release. */
  letGo() {
    this.keys.clear();
    this.dragged = null;
    this.armed = false;
    this.update();
  }

  report() {
    const at = this.position();
    if (this.page === null) return;
    this.visitor.send(at ? { type: "stick", panel: this.panel, held: true, ticket: this.ticket,
      forward: at[0], left: at[1], pressed_s: (performance.now() - this.since) / 1000 }
      : { type: "stick", panel: this.panel, held: false });
  }

  // ---- answers of the HMI ------------------------------------------------------------------------

  begin(hello) {
    this.gamepads = hello.panels.find((panel) => panel.stick).title === this.panel;
    if (this.gamepads && !this.how.textContent.includes("gamepad")) this.how.append(" Or hold a shoulder button of a gamepad.");
  }

  receive(message) {
    if (message.type === "operating") {
      this.page = message.page;
      this.ticket = 0;
      this.visitor.bar(this.row, "stick");
      if (!this.visitor.barred("stick")) this.report();  // the HMI follows only a stick that has been at rest
    } else if (message.type === "stick" && message.panel === this.panel) {
      ({ ticket: this.ticket, drives: this.drives } = message);
      if (message.text || message.drives) this.text = message.text;
    } else {
      return false;
    }
    this.draw();
    return message.type === "stick";
  }

  offline() {
    this.page = null;
    this.drives = false;
    this.draw();
  }

  show(picture, changed) {
    if (!changed.has("operating")) return;
    this.status = picture.operating.sticks[this.panel];
    this.draw();
  }

  draw() {
    const [forward, left] = this.position() || [0, 0];
    this.knob.style.transform = `translate(${-left * 100}%, ${-forward * 100}%)`;
    const driving = Boolean(this.timer) && this.drives;
    this.pad.classList.toggle("driving", driving);
    const { status } = this;
    const other = status && status.holder !== null && status.holder !== this.page;
    const [kind, text] = this.page === null || !status ? ["warn", "not connected"]
      : this.visitor.barred("stick") ? ["", "not permitted"]
        : other ? ["warn", `page ${status.holder} drives`]
          : !status.works ? ["warn", "no effect now"]
            : !driving ? ["", "free"]
              : status.note ? ["warn", "not followed"] : ["good", "you drive"];
    pill(this.state, kind, text);
    this.pad.classList.toggle("useless", Boolean(other || (status && !status.works)));
    say(this.words, [this.text, status?.text, status?.note].filter(Boolean).join(" · "));
  }
}
