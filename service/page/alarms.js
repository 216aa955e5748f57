// What is wrong and what to do about it: the most urgent one beside the image, all of them below.

import { byId, h, replace, whenChanged } from "./dom.js";
import { clock } from "./format.js";
import { TEXTS } from "./texts.js";

const { alarms: words } = TEXTS;

export const drawAlarms = whenChanged((alarms) => {
  const rows = alarms.map((alarm) => h("li", { class: alarm.severity },
    h("time", {}, clock(alarm.since_s)),
    h("span", {}, h("b", {}, alarm.text), " ", h("span", { class: "who" }, `${words.todo} ${alarm.what_to_do}`))));
  replace(byId("alarms"), rows.length ? rows : h("li", { class: "none" }, words.none));
  drawLine(alarms);
});

function drawLine(alarms) {
  const line = byId("alarm-line");
  const worst = alarms.find((alarm) => alarm.severity === "alarm") ?? alarms[0];
  line.className = `card ${worst?.severity ?? ""}`;
  if (!worst) return replace(line, h("span", { class: "quiet" }, words.none));
  const more = alarms.length - 1;
  replace(line, h("time", { class: "num quiet" }, clock(worst.since_s)),
    h("p", {}, h("span", { class: "text" }, worst.text), " ", h("span", { class: "what" }, worst.what_to_do)),
    more ? h("a", { href: "#card-alarms" }, words.more(more)) : null);
}
