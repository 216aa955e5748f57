// No action under the pointer: a button that has just appeared or changed its place takes no click
// that was meant for what was there before.

export const GUARD_MS = 1200;
const LOOK_MS = 100;

export function guard(container) {
  const since = new WeakMap();
  const place = (button) => {
    const { left, top, width, height } = button.getBoundingClientRect();
    return [left, top, width, height].map(Math.round).join();
  };
  const isFresh = (button) => performance.now() - (since.get(button)?.ms ?? performance.now()) < GUARD_MS;
  const look = () => {
    const scrolled = container.getBoundingClientRect().top;
    for (const button of container.querySelectorAll("button")) {
      // scrolling moves the pointer's target by the operator's own hand
      const now = place(button);
      const known = since.get(button);
      if (!known || (known.place !== now && known.scrolled === scrolled)) since.set(button, { place: now, scrolled, ms: performance.now() });
      else if (known.place !== now) since.set(button, { ...known, place: now, scrolled });
      button.classList.toggle("fresh", isFresh(button));
    }
  };
  new MutationObserver(look).observe(container, { childList: true, subtree: true });
  setInterval(look, LOOK_MS);
  container.addEventListener("click", (event) => {
    const button = event.target.closest("button");
    if (!button) return;
    look();
    if (!isFresh(button)) return;
    event.preventDefault();
    event.stopImmediatePropagation();
  }, { capture: true });
  look();
}
