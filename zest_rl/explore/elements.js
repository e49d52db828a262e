// Elements and numbers as the page shows them.

export const $ = (selector) => document.querySelector(selector);

export function element(name, attributes = {}, ...children) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (key === "class") made.className = value;
    else if (key in made) made[key] = value;
    else made.setAttribute(key, value);
  }
  made.append(...children);
  return made;
}

export function digits(value, n = 3) {
  if (value === null || value === undefined) return "–";
  return value.toFixed(n).replace(/^-(?=[0.]*$)/, "").replace("-", "−"); // no −0.00
}
