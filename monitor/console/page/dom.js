// Elements made without markup: what came over a network is only ever text.

/** Return an element with attributes, listeners (functions) and children (elements or texts). */
export function el(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (typeof value === "function") made.addEventListener(name, value);
    else if (value === true) made.setAttribute(name, "");
    else if (value !== false && value !== null && value !== undefined) made.setAttribute(name, value);
  }
  made.append(...children);
  return made;
}

/** Give an element a text where it has another. */
export function say(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/** Let a container have one child for each item, made once, brought up to date, in the order of the items. */
export function sync(container, items, keyOf, make, update) {
  const known = (container.known ??= new Map());
  const wanted = new Set(items.map(keyOf));
  for (const [key, child] of known) {
    if (!wanted.has(key)) {
      child.remove();
      known.delete(key);
    }
  }
  let before = container.firstElementChild;
  for (const item of items) {
    const key = keyOf(item);
    let child = known.get(key);
    if (!child) known.set(key, (child = make(item)));
    update(child, item);
    if (child === before) before = before.nextElementSibling;
    else container.insertBefore(child, before);
  }
}

/** Ask for or keep what this browser shall remember; without storage nothing is remembered. */
export function remembered(name, value) {
  try {
    if (value === undefined) return localStorage.getItem(`fauio-${name}`);
    localStorage.setItem(`fauio-${name}`, value);
  } catch {
    // storage is switched off
  }
  return null;
}
