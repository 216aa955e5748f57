// Comparing the scanner's clock with the room's: somebody reads the scanner's clock off its console
// and presses the button in that second.

import { order } from "./api.js";
import { byId, h, replace, setText, whenChanged } from "./dom.js";
import { act } from "./actions.js";
import { age, day } from "./format.js";
import { TEXTS } from "./texts.js";

const { clock: words } = TEXTS;

const DAY_S = 86400;
// a person presses within this of the second that is shown: its rounding, and the time to react
const UNCERTAINTY_S = 1.0;

const heardS = [];

// The room's clock is that of the service's computer, which need not be this browser's. Messages come
// late by some time or other, never early: the promptest of the last ones tells.
export function heardFromRoom(nowS) {
  heardS.push(nowS - Date.now() / 1000);
  if (heardS.length > 50) heardS.shift();
}

const nowS = () => Date.now() / 1000 + roomMinusBrowserS();

// An age goes on by itself: nothing else on the card is drawn anew for it.
function ageOf(instantS) {
  const text = h("span", { id: "clock-age" }, age(nowS() - instantS));
  const timer = setInterval(() => (text.isConnected ? setText(text, age(nowS() - instantS)) : clearInterval(timer)), 5000);
  return text;
}

const roomMinusBrowserS = () => (heardS.length ? Math.max(...heardS) : 0);

// "10:32:07" -> seconds since midnight, or NaN
function secondsOf(text) {
  const found = /^(\d{1,2}):(\d{2}):(\d{2})$/.exec(text.trim());
  if (!found) return NaN;
  const [hours, minutes, seconds] = found.slice(1).map(Number);
  return hours < 24 && minutes < 60 && seconds < 60 ? 3600 * hours + 60 * minutes + seconds : NaN;
}

// The room's clock minus the scanner's, at this instant; within half a day.
export function offsetS(shown, pressedMs) {
  const room = new Date(pressedMs + 1000 * roomMinusBrowserS());
  const ofDay = 3600 * room.getHours() + 60 * room.getMinutes() + room.getSeconds() + room.getMilliseconds() / 1000;
  // a clock that shows whole seconds shows, on average, half a second too little
  const difference = ofDay - (secondsOf(shown) + 0.5);
  return difference - DAY_S * Math.round(difference / DAY_S);
}

function inWords(offset) {
  if (Math.abs(offset) < 0.05) return words.same;
  return (offset < 0 ? words.ahead : words.behind)(Math.abs(offset).toFixed(1));
}

export const drawScannerClock = whenChanged(({ clock, clock_doubted, clock_implies, role }) => {
  const known = clock
    ? [words.known(inWords(clock.offset_s), clock.uncertainty_s, words.compared(day(clock.compared_s), clock.who)), " (", ageOf(clock.compared_s), ` ${words.ago}). ${clock_implies}`]
    : [clock_implies];
  const input = h("input", { id: "scanner-shows", placeholder: "hh:mm:ss", inputMode: "numeric", autocomplete: "off", size: 9, disabled: role !== "operator" });
  const said = h("p", { class: "quiet", role: "status" });
  let offset = NaN;
  const use = h("button", { type: "button", hidden: true, onclick: () => act(() => order("PUT", "api/v1/clock", { offset_s: offset, uncertainty_s: UNCERTAINTY_S })) }, words.use);
  const compare = h("button", {
    type: "button", disabled: role !== "operator",
    onclick: () => {
      offset = offsetS(input.value, Date.now());
      const good = Number.isFinite(offset);
      setText(said, good ? words.then(inWords(offset)) : words.bad);
      use.hidden = !good;
    },
  }, words.now);
  const forget = h("button", {
    type: "button", disabled: role !== "operator", title: words.forgetTitle,
    onclick: () => act(() => order("POST", "api/v1/clock/reset", { why: words.why })),
  }, words.forget);
  replace(byId("scanner-clock"), h("p", { class: clock_doubted ? "wrong" : "quiet" }, ...known),
    h("p", { class: "row" }, h("label", { htmlFor: "scanner-shows" }, words.reads), input, compare), said, use, clock ? h("p", {}, forget) : null);
});
