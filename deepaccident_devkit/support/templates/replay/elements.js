// Elements of the page: found by their ids, and made. Text of the data is only set as text, never as HTML.

const SVG = "http://www.w3.org/2000/svg";

/**
 * Return the element with an id; an error if there is none of this kind.
 * @template {HTMLElement} Kind
 * @overload
 * @param {string} id
 * @param {new () => Kind} kind
 * @returns {Kind}
 */
/**
 * @overload
 * @param {string} id
 * @returns {HTMLElement}
 */
/**
 * @param {string} id
 * @param {new () => HTMLElement} kind
 */
export function byId(id, kind = HTMLElement) {
  const element = document.getElementById(id);
  if (!(element instanceof kind)) throw new Error(`the page has no ${kind.name} with the id ${id}`);
  return element;
}

/**
 * Make an HTML element.
 * @template {keyof HTMLElementTagNameMap} Name
 * @param {Name} name
 * @param {Partial<HTMLElementTagNameMap[Name]>} properties
 * @param {(Node | string)[]} children
 * @returns {HTMLElementTagNameMap[Name]}
 */
export function made(name, properties, ...children) {
  const element = document.createElement(name);
  Object.assign(element, properties);
  element.append(...children);
  return element;
}

/**
 * Make an SVG element.
 * @template {keyof SVGElementTagNameMap} Name
 * @param {Name} name
 * @param {Record<string, string | number>} attributes
 * @param {(Node | string)[]} children
 * @returns {SVGElementTagNameMap[Name]}
 */
export function drawn(name, attributes, ...children) {
  const element = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, String(value));
  element.append(...children);
  return element;
}

/**
 * Make a spot of a colour.
 * @param {string} color
 * @param {string} kind a class
 */
export function chip(color, kind = "") {
  const element = made("span", { className: `chip ${kind}`, ariaHidden: "true" });
  element.style.background = color;
  return element;
}

/**
 * @param {string} text
 * @param {string} kind a class
 */
export function smallText(text, kind = "") {
  return made("p", { className: `small ${kind}`, textContent: text });
}

/**
 * Make a frame around a word.
 * @param {string} text
 * @param {string} color
 */
export function badge(text, color) {
  const element = made("span", { className: "badge", textContent: text });
  element.style.borderColor = color;
  return element;
}
