// What the operator does, but for missions: drives where that is offered, chooses the strategy, breaks things.

import { $, say } from "./dom.js";
import { Drive } from "./drive.js";
import { Faults } from "./faults.js";

export class Operating {
  constructor(send) {
    this.drive = new Drive(send);
    this.faults = new Faults(send);
    this.current = null;
    $("strategy").addEventListener("submit", (event) => {
      event.preventDefault();
      send({ type: "strategy", name: $("strategy-name").value });
    });
  }

  /** Take a message of the HMI; tell whether it was for this part of the page. */
  receive(message) {
    if (message.type === "operating") {
      const drives = "silence_s" in message;
      $("drive-panel").hidden = !drives;
      this.drive.introduced(drives ? message.page : null);
      this.faults.introduced(message);
      $("strategy-name").replaceChildren(...message.strategies.map((name) => new Option(name, name)));
      this.current = null;
    } else if (message.type === "stick") {
      this.drive.answered(message);
    } else {
      return false;
    }
    return true;
  }

  /** Show the section "operating" of the picture. */
  show(operating) {
    if ("works" in operating) this.drive.show(operating);
    this.faults.show(operating);
    say($("strategy-now"), operating.strategy ? `in force: ${operating.strategy}` : "FTM Manager not heard");
    $("strategy-set").disabled = operating.strategy_asked || !operating.strategy;
    if (operating.strategy && operating.strategy !== this.current) {
      this.current = operating.strategy;
      $("strategy-name").value = operating.strategy;
    }
  }

  offline() {
    this.drive.offline();
  }
}
