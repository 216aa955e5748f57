// The distance to the target with its uncertainty, large; and the close-up of target and fiducial.

import { byId, h, replace, s, setText, whenChanged } from "./dom.js";
import { mm, NONE, percent, sentence } from "./format.js";
import { ellipse, inWords } from "./geometry.js";
import { TEXTS } from "./texts.js";

const { distance: words } = TEXTS;
const SIGMAS = 2;

// Target in the middle, fiducial where it is measured, in mm; rows grow downwards as in the slice.
function closeUp(error, toleranceMm, covariance) {
  const shape = ellipse(covariance ?? [[error.sigma_mm ** 2, 0], [0, error.sigma_mm ** 2]], SIGMAS);
  const reach = Math.max(3 * toleranceMm, 1.1 * (error.error_mm + shape.long), 1.35 * error.error_mm, 0.05);
  const at = [-error.col_mm, -error.row_mm];
  return s("svg", {
    viewBox: `${-reach} ${-reach} ${2 * reach} ${2 * reach}`, role: "img",
    "aria-label": words.closeUp(mm(error.error_mm, 3)),
  },
  s("circle", { r: reach * 0.98, class: "thin c-line" }),
  s("circle", { r: toleranceMm, class: "thin c-target", "data-what": "tolerance" }),
  s("path", { d: `M${-reach} 0H${reach}M0 ${-reach}V${reach}`, class: "thin c-line" }),
  s("line", { x1: at[0], y1: at[1], x2: 0, y2: 0, class: "thin c-plan dash" }),
  s("ellipse", {
    rx: shape.long, ry: shape.short, class: "thin c-fiducial",
    transform: `translate(${at[0]} ${at[1]}) rotate(${shape.turnDeg})`,
  }),
  s("path", { d: `M${at[0] - reach * 0.06} ${at[1]}h${reach * 0.12}M${at[0]} ${at[1] - reach * 0.06}v${reach * 0.12}`, class: "thin c-fiducial" }));
}

const row = (name, value, title) => h("tr", { title }, h("th", { scope: "row" }, name), h("td", {}, value));

// With two fiducials it is the needle's tip that is steered: its distance at READY, or before a move.
function tipError(arrival, plan) {
  if (arrival?.tip_error_mm) {
    const [row_mm, col_mm] = arrival.tip_error_mm;
    return { row_mm, col_mm, error_mm: arrival.error_mm, sigma_mm: arrival.sigma_mm };
  }
  const tip = plan?.parts?.find((part) => part.name === "tip");
  return tip ? { ...tip, error_mm: Math.hypot(tip.row_mm, tip.col_mm), probability_within_tolerance: NaN } : null;
}

function rowsOf(measurement) {
  if (!measurement || measurement.state !== "done") return [];
  return [
    row(words.slices, String(measurement.n_frames)),
    row(words.snr, measurement.snr ? measurement.snr.toFixed(0) : NONE),
    measurement.chi2_per_dof ? row(words.chi2, measurement.chi2_per_dof.toFixed(2)) : null,
    row(words.method, measurement.method),
  ].filter(Boolean);
}

export const drawNumbers = whenChanged(({ error: ofFiducial, measurement, tolerance_mm, arrival, slice, guide, reason, plan }) => {
  const body = byId("error-body");
  const ofTip = guide ? tipError(arrival, plan) : null;
  const error = guide ? ofTip : ofFiducial;
  setText(byId("h-error"), guide ? words.tipHeading : words.heading);
  const rows = rowsOf(measurement);
  if (!error) {
    const failed = measurement?.state === "failed" ? words.noFiducial(measurement.reason) : "";
    const why = failed || (guide ? words.atReady : sentence(reason) || words.nothing);
    replace(body, h("p", { class: "big quiet" }, NONE, h("small", {}, " mm")), h("p", { class: "quiet" }, why),
      rows.length ? h("table", {}, h("tbody", {}, rows)) : null);
    return;
  }
  const shown = arrival ?? error;
  const inside = error.error_mm < tolerance_mm;
  const chance = arrival ? arrival.probability : error.probability_within_tolerance;
  const where = slice ? (arrival && !ofTip ? words.liesByNewest : words.lies)(inWords(slice, error.row_mm, error.col_mm, 3)) : "";
  replace(body,
    h("div", { class: "error-grid" },
      h("div", {},
        h("p", { class: `big ${inside ? "inside" : "outside"}` }, mm(shown.error_mm, shown.error_mm < 10 ? 3 : 2), h("small", {}, " mm")),
        h("p", { class: "pm" }, `± ${mm(shown.sigma_mm, 3)} mm`, h("small", { class: "quiet" }, ` ${words.sigma}`))),
      closeUp(error, tolerance_mm, ofTip ? arrival?.tip_covariance_mm2 : measurement?.covariance_mm2)),
    h("p", { class: "quiet" }, where),
    h("table", {}, h("tbody", {},
      Number.isFinite(chance) ? row(words.within(mm(tolerance_mm, 3)), percent(chance), words.withinTitle) : null,
      ofTip && arrival ? row(words.tipBelow, `${mm(arrival.tip_below_joint_mm, 1)} mm`) : null,
      ...rows)));
});
