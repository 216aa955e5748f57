// What planning stations propose: the coordinates as they came, and the operator's yes or no.

import { order } from "./api.js";
import { byId, h, replace, setHidden, whenChanged } from "./dom.js";
import { act } from "./actions.js";
import { clock, mm } from "./format.js";

const place = (mm3) => `(${mm3.map((value) => mm(value, 2)).join(", ")}) mm LPS`;

// A proposal that has just appeared must be read before it can be answered.
const READ_FIRST_MS = 700;

function row(one, mayAct) {
  const decide = (path, body) => act(() => order("POST", `/api/v1/proposals/${one.number}/${path}`, body));
  const why = h("input", { "aria-label": "Why not", placeholder: "why not", maxLength: 500 });
  const buttons = [
    h("button", { type: "button", disabled: true, onclick: () => decide("take", { in_water: true }) }, "Take over: in tissue"),
    h("button", { type: "button", disabled: true, onclick: () => decide("take", { in_water: false }) }, "Take over: where oil is seen"),
    h("button", { type: "button", disabled: true, onclick: () => decide("refuse", { why: why.value }) }, "Refuse"),
  ];
  if (mayAct) setTimeout(() => buttons.forEach((button) => { button.disabled = false; }), READ_FIRST_MS);
  return h("li", { "data-number": String(one.number) },
    h("p", {}, h("b", {}, one.name || "without a name"), ` from ${one.sender} by ${one.via}, ${clock(one.at_s)}`),
    one.target_mm ? h("p", {}, `Target ${place(one.target_mm)}`) : null,
    one.entry_mm ? h("p", {}, `Entry ${place(one.entry_mm)}`) : null,
    one.note ? h("p", { class: "quiet" }, `Not known yet: ${one.note}.`) : null,
    one.frame_of_reference_uid ? null : h("p", { class: "quiet" }, "The message does not say in which frame of reference: compare the place before taking it over."),
    h("div", { class: "answers" }, buttons[0], buttons[1]),
    h("div", { class: "answers" }, why, buttons[2]));
}

export const drawProposals = whenChanged(({ proposals, role }) => {
  const open = proposals.filter((one) => one.state === "open");
  setHidden(byId("proposals"), open.length === 0);
  replace(byId("proposal-list"), open.map((one) => row(one, role === "operator")));
});
