// Numbers and instants as the operator reads them.

export const NONE = "–";

export function mm(value, digits = 2) {
  return Number.isFinite(value) ? value.toFixed(digits).replace("-", "−") : NONE;
}

export function signedMm(value, digits = 3) {
  if (!Number.isFinite(value)) return NONE;
  return (value < 0 ? "−" : "+") + Math.abs(value).toFixed(digits);
}

export function percent(value) {
  if (!Number.isFinite(value)) return NONE;
  return value > 0.995 && value < 1 ? ">99 %" : `${Math.round(100 * value)} %`;
}

export function age(seconds) {
  if (!Number.isFinite(seconds)) return NONE;
  const whole = Math.max(0, Math.round(seconds));
  if (whole < 60) return `${whole} s`;
  if (whole < 3600) return `${Math.floor(whole / 60)} min ${whole % 60} s`;
  return `${Math.floor(whole / 3600)} h ${Math.floor((whole % 3600) / 60)} min`;
}

export function clock(wallS) {
  return new Date(1000 * wallS).toLocaleTimeString("en-GB");
}

export function day(wallS) {
  return new Date(1000 * wallS).toLocaleString("en-GB", { dateStyle: "medium", timeStyle: "short" });
}

// MOVE_TO_TARGET -> Move to target
export function plain(name) {
  const words = String(name).replaceAll("_", " ").toLowerCase();
  return words.charAt(0).toUpperCase() + words.slice(1);
}

// "measured before the last move" -> "Measured before the last move."
export function sentence(text) {
  return text ? `${text.charAt(0).toUpperCase()}${text.slice(1)}${/[.?!]$/.test(text) ? "" : "."}` : "";
}
