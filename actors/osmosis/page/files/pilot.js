// State of the Safety Pilot, and why.

import { element, pill, say } from "../dom.js";

export default class Pilot {
  constructor(room) {
    this.mode = Object.assign(element("span", "pill"), { id: "pilot-mode" });
    this.reason = Object.assign(element("p"), { id: "pilot-reason" });
    room.title.append(" ", this.mode);
    room.body.append(this.reason);
  }

  begin() { this.show({}, new Set(["pilot"])); }

  show({ pilot: heard }, changed) {
    if (!changed.has("pilot")) return;
    const pilot = heard && heard.value;
    if (!pilot) pill(this.mode, "warn", "not heard");
    else if (heard.stale) pill(this.mode, "warn", "silent");
    else pill(this.mode, pilot.stopped ? "bad" : pilot.mode === "auto" ? "good" : "warn",
      pilot.stopped ? (pilot.mode === "stop" ? "stopped" : `${pilot.mode}, stopped`) : pilot.mode);
    say(this.reason, pilot ? pilot.reason || "Commands pass unchanged." : "");
  }
}
