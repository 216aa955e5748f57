// The top of the page: work phase, link lights, banners, clock, theme; and how tall it all is.

import { byId, h, replace, setHidden, setText, whenChanged } from "./dom.js";
import { age, plain } from "./format.js";
import { TEXTS } from "./texts.js";

const PHASES = ["START_UP", "CALIBRATION", "PLANNING", "TARGETING", "MOVE_TO_TARGET", "MANUAL"];
const ALARM_PHASES = ["STOP", "EMERGENCY"];

// What the case is at. The bridge changes its phase with a motion and not before, so that while nothing
// moves its word is of the past: then what runs, or what is to be done next, says it. STOP is its own.
const OF_NEXT = { calibration: "CALIBRATION", target: "PLANNING", entry: "PLANNING", approach: "TARGETING", puncture: "MOVE_TO_TARGET", "needle-out": "MOVE_TO_TARGET" };

export function phaseOf({ robot, procedure, next_action: next }) {
  if (ALARM_PHASES.includes(robot.phase) || robot.moving) return robot.phase;
  if (procedure) return procedure.includes("calibration") ? "CALIBRATION" : procedure === "jog" ? "MANUAL" : "MOVE_TO_TARGET";
  return OF_NEXT[next] ?? "START_UP";
}

const phase = (name) => TEXTS.phases[name] ?? plain(name);

export const drawPhases = whenChanged(({ phase: now }) => {
  const shown = ALARM_PHASES.includes(now) ? [...PHASES, now] : PHASES;
  replace(byId("phases"), shown.map((name) => h("li", {
    class: ALARM_PHASES.includes(name) ? "alarm" : null,
    "aria-current": name === now ? "step" : null,
  }, phase(name))));
});

// up: works, old: was heard but not lately, down: lost
function lamp(name, condition, title) {
  return h("li", { class: condition, title },
    h("span", { class: `lamp ${condition}`, "aria-hidden": "true" }), name,
    h("span", { class: "heard" }, `: ${TEXTS.conditions[condition]}`));
}

export const drawLights = whenChanged(({ page, robot, processes }) => {
  const { lamp: words } = TEXTS;
  replace(byId("lights"), [
    lamp(words.service, page ? "up" : "down", page ? words.connected : words.notConnected),
    lamp(words.robot, robot.linked ? "up" : "down", robot.linked ? words.bridge(robot.boot_id) : robot.problem),
    ...(processes ?? []).map((process) => lamp(plain(process.name), process.condition, process.detail)),
  ]);
});

export function drawHead(state, connected) {
  drawPhases({ phase: phaseOf(state) });
  drawLights({ page: connected, robot: { linked: state.robot.linked, boot_id: state.robot.boot_id, problem: state.robot.problem }, processes: state.processes });
  setText(byId("room"), state.case?.label ? `${state.room} · ${state.case.label}` : state.room);
  setHidden(byId("banner-virtual"), !state.virtual);
  drawEmergency(state.robot.linked && state.robot.phase === "EMERGENCY");
  document.title = `${state.ready ? "READY" : phase(phaseOf(state))} · ${TEXTS.title}`;
}

function drawEmergency(isOn) {
  const banner = byId("banner-emergency");
  setHidden(banner, !isOn);
  document.body.classList.toggle("emergency", isOn);
  setText(banner, isOn ? TEXTS.banner.emergency : "");
}

// everConnected false: nothing was shown yet that could be old
export function showLost(seconds, everConnected) {
  const banner = byId("banner-lost");
  document.body.classList.toggle("stale", everConnected);
  banner.classList.toggle("connecting", !everConnected);
  setHidden(banner, false);
  if (everConnected) setText(banner, Number.isFinite(seconds) ? TEXTS.banner.lost(age(seconds)) : TEXTS.banner.lostNow);
  else setText(banner, seconds > 5 ? TEXTS.banner.unreachable : TEXTS.banner.connecting);
}

export function showUp() {
  document.body.classList.remove("stale");
  setHidden(byId("banner-lost"), true);
}

export function startHeader() {
  const tick = () => setText(byId("clock"), new Date().toLocaleTimeString("en-GB"));
  tick();
  setInterval(tick, 1000);
  byId("theme").onclick = () => {
    const theme = document.documentElement.dataset.theme === "dark" ? "light" : "dark";
    document.documentElement.dataset.theme = theme;
    try {
      localStorage.setItem("theme", theme);
    } catch {
      // not remembered, still switched
    }
  };
  const top = byId("top");
  const act = byId("act");
  const measure = () => {
    const foot = byId("foot").offsetHeight;
    document.documentElement.style.setProperty("--above", `${top.offsetHeight}px`);
    document.documentElement.style.setProperty("--foot", `${foot}px`);
    // what is taller than the screen goes with the page; STOP stays at its bottom edge
    act.classList.toggle("tall", byId("act-scroll").offsetHeight + foot > innerHeight - top.offsetHeight + 1);
  };
  const watch = new ResizeObserver(measure);
  [top, byId("next"), byId("numbers"), byId("pick-panel"), byId("needle"), byId("jog"), document.documentElement].forEach((one) => watch.observe(one));
  addEventListener("resize", measure);
  measure();
}
