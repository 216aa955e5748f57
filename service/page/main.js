// Ties the page together: who is looking, the event stream, and what is drawn from the state.

import { get, heardClock, readsOldCase } from "./api.js";
import { act, Next, showRefusal } from "./actions.js";
import { drawAlarms } from "./alarms.js";
import { drawBelief } from "./belief.js";
import { byId, setHidden, setText, whenChanged } from "./dom.js";
import { drawCaseDesk, drawHolding } from "./case_desk.js";
import { drawNumbers } from "./distance.js";
import { drawHead, drawLights, phaseOf, showLost, showUp, startHeader } from "./header.js";
import { drawHistory } from "./history_plot.js";
import { guard } from "./guard.js";
import { Images } from "./images.js";
import { addEvent, drawAside, drawCase, drawJog, drawPast, drawTargets } from "./lists.js";
import { Live } from "./live.js";
import { askForToken, leave, whoAmI } from "./login.js";
import { measuredAt } from "./measured_age.js";
import { drawNeedle } from "./needle_view.js";
import { showOldCase } from "./old_case.js";
import { drawProposals } from "./proposals.js";
import { drawScannerClock, heardFromRoom } from "./scanner_clock.js";
import { drawStages } from "./stage_map.js";
import { StopButton } from "./stop_button.js";
import { drawParts, keepCounting } from "./system_status.js";
import { TEXTS } from "./texts.js";

const page = { state: null, role: "viewer", measurements: [], connected: false };
const images = new Images(byId("images"));
const next = new Next(() => images.picking.toggle());
const stop = new StopButton(byId("stop"), byId("stop-said"));
guard(byId("next"));

const HEADINGS = {
  "h-alarms": TEXTS.alarms, "h-belief": TEXTS.belief, "h-history": TEXTS.history, "h-stages": TEXTS.stages, "h-events": TEXTS.events,
  "h-aside": TEXTS.aside, "h-targets": TEXTS.targets, "h-past": TEXTS.past, "h-case": TEXTS.caseCard, "h-clock": TEXTS.clock,
  "h-parts": TEXTS.system, "h-error": TEXTS.distance,
};
for (const [id, { heading }] of Object.entries(HEADINGS)) setText(byId(id), heading);
setText(document.querySelector("#jog summary"), TEXTS.jog.heading);
setText(byId("leave"), TEXTS.login.leave);

function draw(state) {
  if (page.state && (page.state.case_uid !== state.case_uid || page.state.service_id !== state.service_id)) return location.reload();
  page.state = state;
  const { robot, question, belief } = state;
  drawHead(state, page.connected);
  next.draw(state, page.role);
  images.draw(state, page.role);
  drawNumbers({ error: state.error, measurement: state.measurement, tolerance_mm: state.tolerance_mm, arrival: state.arrival, slice: state.slice, guide: state.guide, reason: state.error_reason, plan: question?.plan ?? null });
  drawNeedle({ guide: state.guide && images.showsNeedle(), entry: state.entry_patient_mm, target: state.target_patient_mm, fiducials: belief?.fiducials ?? [], arrival: state.arrival });
  drawStages({ robot: { travel_um: robot.travel_um, positions_um: robot.positions_um, position_certain: robot.position_certain }, plan: question?.plan });
  drawAlarms(state.alarms ?? []);
  drawProposals({ proposals: state.proposals ?? [], role: page.role });
  drawJog({ positions_um: robot.positions_um, possible: page.role === "operator" && state.jog_possible });
  drawCase({ description: state.case, case_uid: state.case_uid, role: page.role });
  const desk = { folder: state.case_folder, role: page.role, busy: Boolean(state.procedure) };
  drawCaseDesk({ ...desk, begins: state.cases_begin_here, asks: Boolean(state.case_question) });
  drawHolding({ ...desk, holding: state.holding });
  drawScannerClock({ clock: state.clock, clock_doubted: state.clock_doubted, clock_implies: state.clock_implies, role: page.role });
  drawParts({ robot: { linked: robot.linked, boot_id: robot.boot_id, phase: robot.phase, problem: robot.problem }, processes: state.processes, slices: state.slices });
  if (belief) drawBelief({ ...belief, settings: page.role === "operator" ? belief.settings : null });
  newAside([state.slices.quarantined, state.hold?.hold_id, page.role]);
  newTargets([state.target_patient_mm, state.procedure, page.role]);
  newPast([state.procedure, state.punctured, state.case]);
  newMeasurements([state.measurement?.measurement_id, state.measurement?.state, state.target_patient_mm]);
  sayPhase(phaseOf(state));
}

// A screen reader hears the phase when it changes (prompt and alarms are live regions of their own).
const sayPhase = whenChanged((phase) => setText(byId("heard"), TEXTS.phases[phase] ?? phase));

const quietly = (promise) => promise.catch(() => { /* the stream says when the service is back */ });
const newAside = whenChanged(() => quietly(drawAside(page.state, page.role)));
const newTargets = whenChanged(() => quietly(drawTargets(page.role)));
const newPast = whenChanged(() => quietly(drawPast()));
const newMeasurements = whenChanged(() => quietly(loadMeasurements()));

async function loadMeasurements() {
  const found = await get("api/v1/measurements?newest=true&limit=60");
  page.measurements = found.reverse();
  drawHistory({ measurements: page.measurements, toleranceMm: page.state.tolerance_mm, guide: page.state.guide });
}

const live = new Live({
  onState: (state) => { heardFromRoom(state.at_s); draw(state); measuredAt(state); stop.heard(state.robot); },
  onEvent: addEvent,
  onClock: (nowS, clockS) => { heardFromRoom(nowS); heardClock(clockS); },
  onUp: () => { page.connected = true; showUp(); },
  onDown: async (seconds, failures) => {
    page.connected = false;
    showLost(seconds, page.state !== null);
    if (page.state) drawLights({ page: false, robot: page.state.robot, processes: page.state.processes });
    if (failures === 4) await quietly(begin());
  },
});

function noCase(error) {
  if (error.code === "no_case") return [];
  throw error;
}

async function begin() {
  let me;
  try {
    me = await whoAmI();
  } catch (error) {
    if (error.status === 401) return askForToken(begin);
    throw error;
  }
  page.role = me.role;
  setText(byId("who"), me.needs_token ? TEXTS.login.who(me.name, me.role) : "");
  setHidden(byId("leave"), !me.needs_token);
  if (readsOldCase()) return showOldCase(images, readsOldCase());
  const events = await get("api/v1/events?newest=true&limit=120").catch(noCase);
  byId("events").replaceChildren();
  events.reverse().forEach(addEvent);
  live.open(events.at(-1)?.event_id ?? 0);
  keepCounting();
}

byId("stop-form").onsubmit = (event) => { event.preventDefault(); stop.press(); };
byId("emergency").onclick = () => stop.press(true);
byId("leave").onclick = () => act(leave);
// STOP from anywhere on the page, whatever has the focus, before anything else sees the key.
addEventListener("keydown", (event) => {
  if (event.key === "Escape") stop.press();
}, { capture: true });
startHeader();

// Until the service answers for the first time: again and again.
async function start() {
  const sinceMs = performance.now();
  for (;;) {
    try {
      await begin();
      return setHidden(byId("banner-lost"), true);
    } catch (error) {
      if (error.status === 404) return showRefusal(error.message); // no such case
      showLost((performance.now() - sinceMs) / 1000, false);
      await new Promise((done) => { setTimeout(done, 500); });
    }
  }
}

start();
