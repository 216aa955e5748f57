// The event stream: the state whenever it changes, each new event of the record, and a beat every
// third of a second, so that silence is noticed even when the connection looks open.

import { openStream } from "./stream.js";

const SILENT_MS = 1000;
// the service answers, but its control loop has not said anything for so long
const OLD_S = 1;

export class Live {
  constructor({ onState, onEvent, onUp, onDown, onClock }) {
    this.on = { onState, onEvent, onUp, onDown, onClock };
    this.lastId = 0;
    this.heardMs = performance.now();
    this.isUp = false;
    this.failures = 0;
    setInterval(() => this.watch(), 250);
  }

  open(afterId) {
    this.lastId = Math.max(afterId, this.lastId);
    this.source?.close();
    const source = openStream(this.lastId);
    this.source = source;
    source.addEventListener("state", (message) => this.heard(() => {
      const heardMs = performance.now() - (message.ageMs ?? 0);
      this.on.onState({ ...JSON.parse(message.data), heard_ms: heardMs });
    }));
    source.addEventListener("record", (message) => this.heard(() => {
      this.lastId = Number(message.lastEventId) || this.lastId;
      this.on.onEvent(JSON.parse(message.data));
    }));
    source.addEventListener("beat", (message) => {
      const { age_s: ageS, now_s: nowS, clock_s: clockS } = JSON.parse(message.data);
      this.on.onClock(nowS, clockS);
      if (ageS > OLD_S) this.lost(ageS);
      else this.heard(() => {});
    });
    source.onerror = () => this.lost();
  }

  heard(act) {
    this.heardMs = performance.now();
    this.failures = 0;
    if (!this.isUp) {
      this.isUp = true;
      this.on.onUp();
    }
    act();
  }

  lost(ageS = (performance.now() - this.heardMs) / 1000) {
    this.isUp = false;
    this.failures += 1;
    this.on.onDown(ageS, this.failures);
  }

  watch() {
    if (!this.source) return; // not asked yet: nobody has logged in
    const silentMs = performance.now() - this.heardMs;
    if (silentMs > SILENT_MS) this.lost(silentMs / 1000);
    // the browser gives up on some errors (a 401, a proxy's 502): ask again ourselves
    if (this.source?.readyState === EventSource.CLOSED || silentMs > 10 * SILENT_MS) {
      this.heardMs = Math.max(this.heardMs, performance.now() - 8 * SILENT_MS);
      this.open(this.lastId);
    }
  }
}
