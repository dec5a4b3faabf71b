// The visitor of the page: log in and out, and requests that the visitor's role does not permit.
//
// The page does not keep the token: the HMI answers with a cookie that scripts cannot read.

import { $, element, say } from "./dom.js";

export const NOT_LOGGED_IN = 4401;
const tabs = new BroadcastChannel("rampart-login");  // the other tabs of this browser

let why = {};               // type of request → why the visitor may not make it
const notes = new WeakMap();

export const barred = (kind) => why[kind] || "";

/** Disable a part of the page, and show why, if the visitor may not make its requests. */
export function bar(part, kind) {
  const text = barred(kind);
  part.inert = Boolean(text);
  part.classList.toggle("barred", Boolean(text));
  if (text && !notes.has(part)) {
    const note = element("p", "quiet why-barred");
    notes.set(part, note);
    part.after(note);
  }
  const note = notes.get(part);
  if (!note) return;
  note.hidden = !text;
  say(note, text);
}

export class Visitor {
  /** `entered` is called after a login, here or in another tab, `left` after a logout. */
  constructor(entered, left) {
    this.entered = entered;
    this.left = left;
    $("login-form").addEventListener("submit", (event) => {
      event.preventDefault();
      this.enter($("login-token").value.trim());
    });
    $("login").addEventListener("cancel", (event) => event.preventDefault());  // the page needs a login
    $("logout").addEventListener("click", () => this.leave());
    tabs.addEventListener("message", (event) => (event.data === "in" ? this.close() : this.left()));
  }

  /** Show the form for a token, with the reason. */
  ask(text) {
    say($("login-text"), text);
    if (!$("login").open) $("login").showModal();
    $("login-token").focus();
  }

  close() {
    if (!$("login").open) return;
    $("login").close();
    $("login-token").value = "";
    this.entered();
  }

  async enter(token) {
    try {
      const answer = await fetch("login", { method: "POST", body: JSON.stringify({ token }) });
      if (!answer.ok) {
        this.ask(`${await answer.text()}.`);
        return;
      }
    } catch {
      this.ask("No answer from the HMI; try again.");
      return;
    }
    this.close();
    tabs.postMessage("in");
  }

  async leave() {
    try {
      await fetch("logout", { method: "POST" });
    } finally {
      tabs.postMessage("out");
      this.left();
    }
  }

  /** Take a message from the HMI; return whether it names the visitor. */
  receive(message) {
    if (message.type !== "visitor") return false;
    why = message.barred;
    document.body.dataset.barred = Object.keys(why).join(" ");
    $("visitor").hidden = $("logout").hidden = !message.logs_out;
    say($("visitor"), `${message.name} · ${message.role}`);
    for (const [part, kind] of [["resets", "reset"], ["strategy", "strategy"], ["inject", "inject"]]) {
      bar($(part), kind);
    }
    say($("signals-barred"), barred("signal"));
    return true;
  }
}
