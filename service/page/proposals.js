// What planning stations propose: the coordinates as they came, and the operator's yes or no.

import { order } from "./api.js";
import { act } from "./actions.js";
import { byId, h, replace, setHidden, whenChanged } from "./dom.js";
import { clock, mm } from "./format.js";
import { TEXTS } from "./texts.js";

const { proposals: words } = TEXTS;
const place = (mm3) => `(${mm3.map((value) => mm(value, 2)).join(", ")})`;

// A proposal that has just appeared must be read before it can be answered.
const READ_FIRST_MS = 700;

function row(one, mayAct) {
  const decide = (path, body) => act(() => order("POST", `api/v1/proposals/${one.number}/${path}`, body));
  const why = h("input", { "aria-label": words.why, placeholder: words.whyHint, maxLength: 500 });
  const button = (text, run) => h("button", { type: "button", disabled: true, onclick: run }, text);
  const buttons = [
    button(words.tissue, () => decide("take", { in_water: true })),
    button(words.oil, () => decide("take", { in_water: false })),
    button(words.refuse, () => decide("refuse", { why: why.value })),
  ];
  if (mayAct) setTimeout(() => buttons.forEach((one) => { one.disabled = false; }), READ_FIRST_MS);
  return h("li", { "data-number": String(one.number) },
    h("p", {}, h("b", {}, one.name || words.unnamed), ` ${words.from(one.sender, one.via, clock(one.at_s))}`),
    one.target_mm ? h("p", {}, words.target(place(one.target_mm))) : null,
    one.entry_mm ? h("p", {}, words.entry(place(one.entry_mm))) : null,
    one.note ? h("p", { class: "quiet" }, words.notYet(one.note)) : null,
    one.frame_of_reference_uid ? null : h("p", { class: "quiet" }, words.noFrame),
    h("div", { class: "row more" }, buttons[0], buttons[1]),
    h("div", { class: "row more" }, why, buttons[2]));
}

export const drawProposals = whenChanged(({ proposals, role }) => {
  const open = proposals.filter((one) => one.state === "open");
  setHidden(byId("proposals"), open.length === 0);
  replace(byId("proposal-list"), open.map((one) => row(one, role === "operator")));
});
