// Before arming: where the stages stand that lost count of it. The fields hold what is assumed; the
// operator corrects what is not so, and by arming says that all of them are right.

import { order } from "./api.js";
import { h, setHidden, setText } from "./dom.js";
import { mm } from "./format.js";
import { TEXTS } from "./texts.js";

const { stand: words } = TEXTS;

// What is wrong with a position as typed; empty if nothing is.
function wrongWith(um, travel) {
  if (!Number.isFinite(um)) return words.notNumber;
  if (travel && (um < travel[0] || um > travel[1])) return words.outside(mm(travel[0] / 1000), mm(travel[1] / 1000));
  return "";
}

function field(axis, assumedUm, travel, mayAct) {
  const wrong = h("p", { class: "wrong", id: `stand-${axis}-wrong`, role: "alert" });
  const was = h("span", { class: "quiet" });
  const input = h("input", {
    type: "number", id: `stand-${axis}`, step: 0.001, inputMode: "decimal", value: (assumedUm / 1000).toFixed(3), disabled: !mayAct,
    "aria-label": words.field(axis), "aria-describedby": wrong.id, oninput: () => check(),
  });
  const um = () => Math.round(1000 * input.valueAsNumber);
  const check = () => {
    const told = wrongWith(um(), travel);
    setText(wrong, told && `${axis}: ${told}`);
    setHidden(wrong, !told);
    input.setAttribute("aria-invalid", String(Boolean(told)));
    setText(was, um() === assumedUm ? words.unit : words.assumed(mm(assumedUm / 1000, 3)));
    return !told;
  };
  check();
  return { axis, um, check, input, row: [h("label", { htmlFor: input.id }, axis), input, was, wrong] };
}

// What was typed stays while the state is drawn anew; only another assumption makes another form.
export class StandForm {
  // act: carries out an order and shows why it was refused
  constructor(act) {
    this.act = act;
  }

  draw(robot, label, isMain, mayAct) {
    const key = JSON.stringify([robot.taken_um, robot.taken_from, robot.travel_um, mayAct]);
    if (key !== this.key) this.build(robot, mayAct);
    this.key = key;
    setText(this.button, words.confirm(label));
    this.button.className = isMain ? "main" : "";
    return this.form;
  }

  build(robot, mayAct) {
    this.fields = Object.entries(robot.taken_um).map(([axis, um]) => field(axis, um, robot.travel_um[axis], mayAct));
    this.button = h("button", { disabled: !mayAct, title: mayAct ? null : TEXTS.next.viewersOnly });
    this.form = h("form", { id: "stand", noValidate: true, onsubmit: (event) => { event.preventDefault(); this.submit(); } },
      h("fieldset", {}, h("legend", {}, words.heading), h("p", { class: "quiet" }, words.from(robot.taken_from)),
        h("div", { class: "stands" }, this.fields.map((one) => one.row))),
      this.button);
  }

  submit() {
    const bad = this.fields.filter((one) => !one.check());
    if (bad.length) return bad[0].input.focus();
    return this.act(() => order("POST", "api/v1/reset", { positions_um: Object.fromEntries(this.fields.map((one) => [one.axis, one.um()])) }));
  }
}
