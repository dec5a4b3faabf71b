// Driving from the page: arrow keys or WASD, a stick to drag, a gamepad. Each is its own dead man.
//
// While something is held, the position is sent 20 times a second with the newest ticket of the
// HMI; silence is letting go. Whatever ends the hold (key up, pointer up, focus lost, tab hidden,
// page closed) says so at once. After a connection was lost everything must be let go first.

import { $, pill, say } from "./dom.js";

const PERIOD_MS = 50;
const DEAD_ZONE = .12;
const SHOULDERS = [4, 5];  // of a standard gamepad: either is the dead man
const KEYS = {
  ArrowUp: [1, 0], KeyW: [1, 0], ArrowDown: [-1, 0], KeyS: [-1, 0],
  ArrowLeft: [0, 1], KeyA: [0, 1], ArrowRight: [0, -1], KeyD: [0, -1],
};

const clip = (value) => Math.min(Math.max(value, -1), 1);

export class Drive {
  constructor(send) {
    this.send = send;
    this.keys = new Set();
    this.dragged = null;
    this.held = false;
    this.barred = false;
    this.ticket = 0;
    this.page = null;
    this.grip = "free";
    this.refusal = "";
    this.status = null;
    this.timer = null;
    this.pad = $("stick");
    this.knob = $("stick-knob");
    this.listen();
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
    addEventListener("gamepadconnected", () => this.pollGamepad());
    addEventListener("gamepaddisconnected", () => this.update());
  }

  key(event, down) {
    if (!(event.code in KEYS) || event.ctrlKey || event.altKey || event.metaKey) return;
    event.preventDefault();  // do not scroll
    if (down && event.repeat && !this.keys.has(event.code)) return;  // held since before: press anew
    if (down) this.keys.add(event.code); else this.keys.delete(event.code);
    this.update();
  }

  drag(event) {
    const box = this.pad.getBoundingClientRect();
    const radius = box.width / 2;
    let [x, y] = [(event.clientX - box.left) / radius - 1, (event.clientY - box.top) / radius - 1];
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

  /** Position of the gamepad whose shoulder button is held, or null. */
  gamepad() {
    for (const pad of navigator.getGamepads ? navigator.getGamepads() : []) {
      if (!pad || !pad.connected || !SHOULDERS.some((i) => pad.buttons[i]?.pressed)) continue;
      const axis = (i) => (Math.abs(pad.axes[i] || 0) < DEAD_ZONE ? 0 : pad.axes[i]);
      return [-axis(1), -axis(0)];
    }
    return null;
  }

  /** Where the stick is: [forward, left] in [-1, 1], or null if nothing is held. */
  position() {
    const share = $("stick-share").valueAsNumber / 100;
    const pad = this.gamepad();
    if (this.dragged || pad) return (this.dragged || pad).map((value) => clip(value * share));
    if (!this.keys.size) return null;
    let [forward, left] = [0, 0];
    for (const code of this.keys) { forward += KEYS[code][0]; left += KEYS[code][1]; }
    return [clip(forward) * share, clip(left) * share];
  }

  /** Something was pressed or let go. */
  update() {
    const at = this.position();
    if (!at) {
      this.barred = false;
      this.release();
    } else if (!this.held && !this.barred) {
      this.held = true;
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
    this.barred = this.gamepad() !== null;  // it is pressed still
    this.release();
    this.draw();
  }

  release() {
    if (!this.held) return;
    this.held = false;
    clearInterval(this.timer);
    this.send({ type: "stick", held: false });
  }

  speak() {
    const at = this.position();
    if (!at) { this.update(); return; }
    this.send({ type: "stick", held: true, ticket: this.ticket, forward: at[0], left: at[1] });
  }

  // ---- what the HMI says ------------------------------------------------------------------------

  introduced(page) {
    this.page = page;
    this.ticket = 0;
  }

  answered(message) {
    this.ticket = message.ticket;
    this.grip = message.grip;
    if (message.text) this.refusal = message.text;
    else if (message.grip === "drives") this.refusal = "";
    if (message.grip === "waits" && this.held) this.speak();  // now with a ticket
    this.draw();
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

  show(operating) {
    this.status = operating;
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
    if (this.page === null || !status) pill("stick-state", "warn", "not connected");
    else if (other) pill("stick-state", "warn", `page ${status.holder} drives`);
    else if (!status.works) pill("stick-state", "warn", "no effect now");
    else if (driving) pill("stick-state", "good", "you drive");
    else pill("stick-state", "", "free");
    this.pad.classList.toggle("useless", Boolean(status && (other || !status.works)));
    const texts = [this.barred ? "let go first, then press again" : this.refusal,
      status ? status.text : "", status && !this.held ? status.note : ""];
    say($("stick-text"), texts.filter(Boolean).join(" · "));
  }
}
