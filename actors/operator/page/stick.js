// A stick: arrow keys or WASD, a pad to drag, a gamepad. Each is its own dead man.
//
// While something is held, the position is sent 20 times a second with the newest ticket of the
// HMI; silence is letting go. Whatever ends the hold (key up, pointer up, focus lost, tab hidden,
// page closed) says so at once.
//
// *Barred* is what was held when it must not drive: before there was a connection, across the loss
// of one, without focus, or so long that the connection must be stalled. It has to be let go first:
// the robot moves because somebody presses, never because something recovers.

import { element, pill, say } from "./dom.js";

const PERIOD_MS = 50;
const PATIENCE_MS = 1000;  // so long a press may wait until it drives; see `answered`
const DEAD_ZONE = .12;
const SHOULDERS = [4, 5];  // of a standard gamepad: either is the dead man
const KEYS = {
  ArrowUp: [1, 0], KeyW: [1, 0], ArrowDown: [-1, 0], KeyS: [-1, 0],
  ArrowLeft: [0, 1], KeyA: [0, 1], ArrowRight: [0, -1], KeyD: [0, -1],
};

const clip = (value) => Math.min(Math.max(value, -1), 1);

export class Stick {
  static kind = "stick";

  constructor(room, page) {
    this.send = page.send;
    this.visitor = page;
    this.panel = page.declared.title;
    this.axes = page.declared.stick.length;  // forward alone, or left as well
    this.gamepads = false;  // a gamepad is for the first stick of a page
    this.keys = new Set();
    this.dragged = null;
    this.held = false;
    this.heldSince = 0;
    this.met = false;  // whether the present hold was answered
    this.drove = false;  // whether it has driven
    this.barred = false;
    this.focused = document.hasFocus();
    this.ticket = 0;
    this.page = null;
    this.grip = "free";
    this.refusal = "";
    this.status = null;
    this.timer = null;
    this.build(room);
    this.listen();
  }

  build(room) {
    const named = (tag, what) => Object.assign(element(tag), { id: `${room.title.id}-${what}` });
    room.section.classList.add("operate");
    const state = element("span", "stick-state");
    this.state = element("span", "pill warn", "not connected");
    state.append(this.state);
    room.title.append(" ", state);
    this.pad = element("div", this.axes > 1 ? "stick" : "stick upright");
    this.pad.tabIndex = 0;
    this.wanted = this.axes > 1 ? "arrow keys or W A S D" : "up or down key, W or S";
    this.pad.setAttribute("role", "application");
    this.pad.setAttribute("aria-label", `Stick: hold the ${this.wanted} to drive`);
    this.knob = element("div", "stick-knob");
    this.pad.append(this.knob);
    const words = element("div", "stick-words");
    const speed = element("label", "", "Speed ");
    this.share = Object.assign(element("input"), { type: "range", min: 10, max: 100, step: 10, value: 50 });
    speed.append(this.share);
    this.how = named("p", "how");
    this.how.className = "quiet";
    this.words = named("p", "text");
    this.words.className = "stick-text";
    this.words.setAttribute("role", "status");
    this.pad.setAttribute("aria-describedby", `${this.how.id} ${this.words.id}`);
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
      if (this.pressed()) this.barred = true;  // plugging in moves nothing
      this.pollGamepad();
    });
    addEventListener("gamepaddisconnected", () => this.update());
  }

  key(event, down) {
    if (event.ctrlKey || event.altKey || event.metaKey) {
      this.letGo();  // a browser need not tell which keys are let go under one of these
      return;
    }
    if (!KEYS[event.code]?.slice(0, this.axes).some(Boolean)) return;
    event.preventDefault();  // do not scroll
    if (down && event.repeat && !this.keys.has(event.code)) return;  // held since before: press anew
    if (down) this.keys.add(event.code); else this.keys.delete(event.code);
    this.update();
  }

  drag(event) {
    const box = this.pad.getBoundingClientRect();
    const radius = box.width / 2;
    let [x, y] = [(event.clientX - box.left) / radius - 1, (event.clientY - box.top) / radius - 1];
    if (this.axes < 2) x = 0;
    const length = Math.hypot(x, y);
    if (length > 1) { x /= length; y /= length; }
    this.dragged = [-y, -x];
    this.update();
  }

  pollGamepad() {
    if (this.polling) return;
    this.polling = setInterval(() => {
      if (![...navigator.getGamepads()].some(Boolean)) {
        clearInterval(this.polling);
        this.polling = null;
      }
      this.update();
    }, PERIOD_MS);
  }

  /** Position of the gamepad whose shoulder button is held, or null: it drives a window with focus. */
  gamepad() {
    return document.hasFocus() ? this.pressed() : null;
  }

  /** The same, whoever has the focus. */
  pressed() {
    for (const pad of this.gamepads && navigator.getGamepads ? navigator.getGamepads() : []) {
      if (!pad || !pad.connected || !SHOULDERS.some((i) => pad.buttons[i]?.pressed)) continue;
      const axis = (i) => (Math.abs(pad.axes[i] || 0) < DEAD_ZONE ? 0 : pad.axes[i]);
      return [-axis(1), this.axes > 1 ? -axis(0) : 0];
    }
    return null;
  }

  /** Where the stick is: [forward, left] in [-1, 1], or null if nothing is held. */
  position() {
    if (this.visitor.barred("stick")) return null;
    const share = this.share.valueAsNumber / 100;
    const pad = this.gamepad();
    if (this.dragged || pad) return (this.dragged || pad).map((value) => clip(value * share));
    if (!this.keys.size) return null;
    let [forward, left] = [0, 0];
    for (const code of this.keys) { forward += KEYS[code][0]; left += KEYS[code][1]; }
    return [clip(forward) * share, clip(left) * share];
  }

  /** Something was pressed or let go. */
  update() {
    const focused = document.hasFocus();
    if (focused && !this.focused && this.pressed()) this.barred = true;  // meant for another window
    this.focused = focused;
    const at = this.position();
    if (!at) {
      this.barred = false;
      this.release();
    } else if (this.page === null) {
      this.barred = true;
    } else if (!this.held && !this.barred) {
      this.held = true;
      this.heldSince = performance.now();
      this.met = this.drove = false;
      this.refusal = "";
      this.timer = setInterval(() => this.speak(), PERIOD_MS);
      this.speak();
    }
    this.draw();
  }

  /** Forget what is held: its end may not be told to a page without focus. */
  letGo() {
    this.keys.clear();
    this.dragged = null;
    this.barred = this.pressed() !== null;  // it is still
    this.release();
    this.draw();
  }

  release() {
    if (!this.held) return;
    this.held = false;
    clearInterval(this.timer);
    this.send({ type: "stick", panel: this.panel, held: false });
  }

  speak() {
    const at = this.position();
    if (!at) { this.update(); return; }
    this.send({ type: "stick", panel: this.panel, held: true, ticket: this.ticket, forward: at[0], left: at[1] });
  }

  // ---- what the HMI says ------------------------------------------------------------------------

  begin(hello) {
    this.gamepads = hello.panels.find((panel) => panel.stick).title === this.panel;
    const gamepad = this.gamepads ? ", or hold a shoulder button of a gamepad" : "";
    say(this.how, `Drag the stick, or click it and hold the ${this.wanted}${gamepad}. Letting go stops.`);
  }

  receive(message) {
    if (message.type === "operating") this.introduced(message.page);
    if (message.type !== "stick" || message.panel !== this.panel) return false;
    this.answered(message);
    return true;
  }

  introduced(page) {
    this.page = page;
    this.visitor.bar(this.row, "stick");
    this.ticket = 0;
    this.barred = this.position() !== null;
    this.draw();
  }

  answered(message) {
    this.ticket = message.ticket;
    this.grip = message.grip;
    if (message.text) this.refusal = message.text;
    else if (message.grip === "drives") this.refusal = "";
    if (this.held && !this.drove && ["waits", "drives"].includes(message.grip)) this.go(message.grip);
    this.draw();
  }

  /** The present hold was answered and has not driven yet: go on, unless it was pressed too long ago. */
  go(grip) {
    if (performance.now() - this.heldSince > PATIENCE_MS) {
      this.release();
      this.barred = true;
      this.refusal = "the connection is too slow to drive, or was stalled";
    } else if (grip === "drives") {
      this.drove = true;
    } else if (!this.met) {
      this.met = true;
      this.speak();  // now with a ticket
    }
  }

  offline() {
    if (this.held) {
      this.held = false;
      this.barred = true;
      clearInterval(this.timer);
    }
    this.grip = "free";
    this.page = null;
    this.draw();
  }

  show(picture, changed) {
    if (!changed.has("operating")) return;
    this.status = picture.operating.sticks[this.panel];
    this.draw();
  }

  draw() {
    const at = this.position();
    const [forward, left] = at || [0, 0];
    this.knob.style.transform = `translate(${-left * 100}%, ${-forward * 100}%)`;
    const driving = this.held && this.grip === "drives";
    this.pad.classList.toggle("driving", driving);
    const status = this.status;
    const other = status && status.holder !== null && status.holder !== this.page;
    if (this.page === null || !status) pill(this.state, "warn", "not connected");
    else if (this.visitor.barred("stick")) pill(this.state, "", "not for you");
    else if (other) pill(this.state, "warn", `page ${status.holder} drives`);
    else if (!status.works) pill(this.state, "warn", "no effect now");
    else if (driving && status.note) pill(this.state, "warn", "not followed");
    else if (driving) pill(this.state, "good", "you drive");
    else pill(this.state, "", "free");
    this.pad.classList.toggle("useless", Boolean(status && (other || !status.works)));
    const texts = [this.refusal, this.barred ? "let go first, then press again" : "",
      status ? status.text : "", status ? status.note : ""];
    say(this.words, texts.filter(Boolean).join(" · "));
  }
}
