// A case of before, read only: its slices, measurements, targets and events. STOP acts on the room of
// now all the same; nothing else here does.

import { get, ofCase } from "./api.js";
import { byId, h, replace, setHidden, setText } from "./dom.js";
import { drawHistory } from "./history_plot.js";
import { addEvent, drawAside, drawPast, drawTargets } from "./lists.js";
import { TEXTS } from "./texts.js";

const { oldCase: words } = TEXTS;
const OF_THE_ROOM = ["card-alarms", "card-belief", "card-stages", "card-case", "card-clock", "card-parts", "alarm-line", "numbers", "jog", "phases", "lights"];

async function patiently(path) {
  for (let again = 0; ; again += 1) {
    try {
      return await get(ofCase(path));
    } catch (error) {
      if (error.status !== 429 || again > 20) throw error;
      await new Promise((done) => { setTimeout(done, 500); });
    }
  }
}

export async function showOldCase(images, name) {
  OF_THE_ROOM.forEach((id) => setHidden(byId(id), true));
  setText(byId("prompt"), words.prompt(name));
  setText(byId("prompt-more"), words.more);
  replace(byId("actions"), h("a", { href: "?" }, words.back),
    h("a", { href: ofCase("api/v1/report"), target: "_blank", rel: "noopener" }, TEXTS.caseCard.report));
  // one after the other: an old case is read by one reader at a time
  const slices = await patiently("api/v1/slices?newest=true&limit=1&state=assigned");
  const measurements = await patiently("api/v1/measurements?newest=true&limit=60");
  const events = await patiently("api/v1/events?newest=true&limit=120");
  const aside = await patiently("api/v1/slices?newest=true&limit=30&state=quarantined");
  const [newest] = slices;
  const done = measurements.find((one) => one.state === "done" && one.patient_mm);
  images.draw({
    slice: newest ? { ...newest, ...newest.geometry } : null, last_slice_id: newest?.slice_id, slices: { quarantined: aside.length },
    measurement: done ?? null, reconstruction: null, tolerance_mm: 0, robot: { positions_um: {}, travel_um: {} },
  }, "viewer");
  events.reverse().forEach(addEvent);
  drawHistory({ measurements: measurements.reverse(), toleranceMm: null, guide: false });
  await drawTargets("viewer");
  await drawAside({ slices: { quarantined: aside.length } }, "viewer");
  await drawPast();
}
