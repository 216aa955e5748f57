// One event stream for all tabs of a browser: it opens at most six connections to one host, and a
// stream holds one for ever. Tells each tab what comes, and a new one the newest state.

const KEPT = 400;
const ports = new Set();
let source = null;
let address = "";
let state = null;
let events = [];
let lastId = 0;

const tell = (port, message) => port.postMessage(message);
const tellAll = (message) => ports.forEach((port) => tell(port, message));

function open() {
  source?.close();
  source = new EventSource(`${address}?after=${lastId}`);
  for (const type of ["state", "record", "beat"]) {
    source.addEventListener(type, (message) => {
      const told = { type, data: message.data, lastEventId: message.lastEventId };
      if (type === "state") state = { ...told, heardMs: performance.now() };
      if (type === "record") {
        lastId = Number(message.lastEventId) || lastId;
        events = [...events.slice(1 - KEPT), told];
      }
      tellAll(told);
    });
  }
  source.onerror = () => tellAll({ type: "error", readyState: source.readyState });
}

function join(port, wanted) {
  ports.add(port);
  const isNew = address !== wanted.address;
  address = wanted.address;
  if (isNew) {
    [state, events, lastId] = [null, [], wanted.after];
  }
  if (isNew || !source || source.readyState === EventSource.CLOSED) return open();
  events.filter((event) => Number(event.lastEventId) > wanted.after).forEach((event) => tell(port, event));
  if (state) tell(port, { ...state, ageMs: performance.now() - state.heardMs });
}

function leave(port) {
  ports.delete(port);
  if (ports.size > 0) return;
  source?.close();
  source = null;
}

onconnect = ({ ports: [port] }) => {
  port.onmessage = ({ data }) => {
    if (data.what === "join") join(port, data);
    else if (data.what === "end") { source?.close(); source = null; }
    else leave(port);
  };
};
