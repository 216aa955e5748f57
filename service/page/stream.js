// The event stream as a tab sees it: shared with the browser's other tabs where it can be; else its
// own, which rests while the tab is hidden. Behaves like an EventSource.

const CLOSED = 2;

export function openStream(after) {
  const address = new URL("api/v1/events/live", document.baseURI).href;
  try {
    return new SharedStream(address, after);
  } catch {
    return new OwnStream(address, after);
  }
}

let worker = null;

class SharedStream {
  constructor(address, after) {
    worker ??= new SharedWorker(new URL("./stream_worker.js", import.meta.url), { name: "autospine" });
    this.handlers = {};
    this.readyState = 0;
    this.port = worker.port;
    this.port.onmessage = ({ data }) => this.take(data);
    this.port.postMessage({ what: "join", address, after });
    worker.onerror = () => this.fail(CLOSED);
    addEventListener("pagehide", () => this.port.postMessage({ what: "leave" }));
  }

  addEventListener(type, handler) { this.handlers[type] = handler; }

  take({ type, data, lastEventId, readyState, ageMs }) {
    if (type === "error") return this.fail(readyState);
    this.readyState = 1;
    this.handlers[type]?.({ data, lastEventId, ageMs });
  }

  fail(readyState) {
    this.readyState = readyState;
    this.onerror?.();
  }

  close() {
    this.handlers = {};
    this.port.postMessage({ what: "leave" });
  }
}

class OwnStream {
  constructor(address, after) {
    Object.assign(this, { address, handlers: {}, lastId: after });
    this.rest = () => (document.hidden ? this.source?.close() : this.open());
    document.addEventListener("visibilitychange", this.rest);
    this.open();
  }

  open() {
    this.source?.close();
    this.source = new EventSource(`${this.address}?after=${this.lastId}`);
    for (const type of ["state", "record", "beat"]) {
      this.source.addEventListener(type, (message) => {
        this.lastId = Number(message.lastEventId) || this.lastId;
        this.handlers[type]?.(message);
      });
    }
    this.source.onerror = () => this.onerror?.();
  }

  get readyState() { return document.hidden ? 1 : this.source.readyState; }

  addEventListener(type, handler) { this.handlers[type] = handler; }

  close() {
    document.removeEventListener("visibilitychange", this.rest);
    this.source.close();
  }
}
