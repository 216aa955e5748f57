// Small ways to make and change elements. Text only ever goes in as text, never as markup.

const SVG = "http://www.w3.org/2000/svg";

export const byId = (id) => document.getElementById(id);

function fill(element, attributes, children) {
  for (const [name, value] of Object.entries(attributes ?? {})) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (name === "class") element.setAttribute("class", value);
    else if (name in element && !(element instanceof SVGElement)) element[name] = value;
    else element.setAttribute(name, value === true ? "" : value);
  }
  element.append(...children.flat(Infinity).filter((child) => child !== null && child !== undefined));
  return element;
}

export function h(tag, attributes, ...children) {
  return fill(document.createElement(tag), attributes, children);
}

export function s(tag, attributes, ...children) {
  return fill(document.createElementNS(SVG, tag), attributes, children);
}

// Only touches the document when something changed: no flicker, no lost selection.
export function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

export function setHidden(element, hidden) {
  if (element.hidden !== hidden) element.hidden = hidden;
}

// What identifies a control from one drawing to the next.
function signature(element) {
  const same = (other) => other.tagName === element.tagName && other.id === element.id
    && (other.getAttribute("aria-label") ?? other.textContent) === (element.getAttribute("aria-label") ?? element.textContent);
  return same;
}

// Draws anew. The keyboard stays where it was; where its control is gone, at the section's head.
export function replace(element, ...children) {
  const focused = document.activeElement;
  const same = element.contains(focused) && focused !== element ? signature(focused) : null;
  element.replaceChildren(...children.flat(Infinity).filter((child) => child !== null && child !== undefined));
  if (!same || element.contains(document.activeElement)) return;
  const again = [...element.querySelectorAll(focused.tagName)].find(same) ?? element.closest("[tabindex='-1']");
  again?.focus({ preventScroll: true });
}

// Calls `draw` only when what it would draw from is different from the last time.
export function whenChanged(draw) {
  let before;
  return (value, ...rest) => {
    const now = JSON.stringify(value);
    if (now === before) return;
    before = now;
    draw(value, ...rest);
  };
}

// At most so many rows at once: long lists grow on demand instead of scrolling inside the page.
export function shortened(rows, most, words, isOpen, onToggle) {
  if (rows.length <= most) return [rows, null];
  const button = h("button", { type: "button", class: "small more", onclick: onToggle }, isOpen ? words.fewer : words.more);
  return [isOpen ? rows : rows.slice(0, most), button];
}
