// The top line: work phase, link lights, banners, clock.

import { byId, h, replace, setHidden, setText, whenChanged } from "./dom.js";
import { age, plain } from "./format.js";

const PHASES = ["START_UP", "CALIBRATION", "PLANNING", "TARGETING", "MOVE_TO_TARGET", "MANUAL"];
const ALARM_PHASES = ["STOP", "EMERGENCY"];

export const drawPhases = whenChanged(({ phase }) => {
  const shown = ALARM_PHASES.includes(phase) ? [...PHASES, phase] : PHASES;
  replace(byId("phases"), shown.map((name) => h("li", {
    class: ALARM_PHASES.includes(name) ? "alarm" : null,
    "aria-current": name === phase ? "step" : null,
  }, plain(name))));
});

// up: works, old: was heard but not lately, down: lost
function lamp(name, condition, title) {
  const words = { up: "works", down: "lost", old: "quiet", none: "not seen yet" };
  return h("li", { class: condition, title },
    h("span", { class: `lamp ${condition}`, "aria-hidden": "true" }), name,
    h("span", { class: "skip" }, `: ${words[condition]}`));
}

export const drawLights = whenChanged(({ page, robot, processes }) => {
  const rows = [
    lamp("Service", page ? "up" : "down", page ? "This page is connected." : "This page is not connected."),
    lamp("Robot", robot.linked ? "up" : "down", robot.linked ? `Bridge start ${robot.boot_id}` : robot.problem),
    ...(processes ?? []).map((process) => lamp(plain(process.name), process.condition, process.detail)),
  ];
  replace(byId("lights"), rows);
});

export function drawHead(state, connected) {
  drawPhases({ phase: state.robot.phase });
  drawLights({ page: connected, robot: { linked: state.robot.linked, boot_id: state.robot.boot_id, problem: state.robot.problem }, processes: state.processes });
  setText(byId("room"), state.case?.label ? `${state.room} · ${state.case.label}` : state.room);
  setHidden(byId("banner-virtual"), !state.virtual);
  drawEmergency(state.robot.linked && state.robot.phase === "EMERGENCY");
  document.title = `${state.ready ? "READY" : plain(state.robot.phase)} · AutoSPINe Navigator`;
}

function drawEmergency(isOn) {
  const banner = byId("banner-emergency");
  setHidden(banner, !isOn);
  document.body.classList.toggle("emergency", isOn);
  setText(banner, isOn ? "EMERGENCY: the robot is stopped and its drives are parked, without power. See to the patient and the needle first. Only Re-arm leaves this; measure again before any move, for parking shifts the stages a little." : "");
}

export function showLost(seconds) {
  document.body.classList.add("stale");
  const banner = byId("banner-lost");
  setHidden(banner, false);
  setText(banner, `Connection lost: what is shown is ${age(seconds)} old. STOP is tried all the same; use the stop switch at the robot.`);
}

export function showUp() {
  document.body.classList.remove("stale");
  setHidden(byId("banner-lost"), true);
}

export function startClock() {
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
}
