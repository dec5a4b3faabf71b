// What the operator does on every page: chooses the strategy, breaks things.

import { $, say } from "./dom.js";
import { Faults } from "./faults.js";

export class Operating {
  constructor(send) {
    this.faults = new Faults(send);
    this.current = null;
    $("strategy").addEventListener("submit", (event) => {
      event.preventDefault();
      send({ type: "strategy", name: $("strategy-name").value });
    });
  }

  /** Take a message of the HMI; tell whether it was for this part of the page. */
  receive(message) {
    if (message.type !== "operating") return false;
    this.faults.introduced(message);
    $("strategy-name").replaceChildren(...message.strategies.map((name) => new Option(name, name)));
    this.current = null;
    return true;
  }

  /** Show the section "operating" of the picture. */
  show(operating) {
    this.faults.show(operating);
    say($("strategy-now"), operating.strategy ? `in force: ${operating.strategy}` : "FTM Manager not heard");
    $("strategy-set").disabled = operating.strategy_asked || !operating.strategy;
    if (operating.strategy && operating.strategy !== this.current) {
      this.current = operating.strategy;
      $("strategy-name").value = operating.strategy;
    }
  }
}
