// STOP says what became of it, at the button and within a second, whatever is gone.

import { stopRobot } from "./api.js";
import { setText } from "./dom.js";

const ANSWER_MS = 950;
const SHOWN_MS = 5000;
const WORDS = {
  sending: "…",
  stopped: "stopped",
  on_its_way: "on its way",
  not_delivered: "NOT DELIVERED – USE THE STOP SWITCH",
};

export class StopButton {
  // said: an element with role="alert" at the button; ask: sends a STOP, its answer says the outcome.
  constructor(button, said, ask = stopRobot) {
    Object.assign(this, { button, said, ask });
    this.presses = 0;
    this.outcome = "";
  }

  press(emergency = false) {
    const mine = ++this.presses;
    this.show("sending");
    // no answer is an answer: silence must not look like success
    const late = setTimeout(() => mine === this.presses && this.show("not_delivered"), ANSWER_MS);
    const say = (outcome) => {
      clearTimeout(late);
      if (mine === this.presses) this.show(outcome in WORDS ? outcome : "not_delivered");
    };
    return this.ask(emergency).then(say, () => say("not_delivered"));
  }

  // What the room says since then: a STOP that was on its way has arrived, or has been re-armed.
  heard({ linked, stopped, moving, armed }) {
    if (this.outcome === "" || this.outcome === "sending") return;
    if (linked && stopped && !moving) this.show("stopped");
    else if (linked && !stopped && armed && this.outcome === "stopped") this.show("");
  }

  show(outcome) {
    this.outcome = outcome;
    this.button.dataset.outcome = outcome;
    setText(this.said, WORDS[outcome] ?? "");
    clearTimeout(this.fading);
    if (outcome === "stopped") this.fading = setTimeout(() => this.show(""), SHOWN_MS);
  }
}
