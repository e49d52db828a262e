// Curves as SVG: small ones without axes, and charts of an episode whose cursors move together.

import { digits, element } from "./elements.js";

const SVG = "http://www.w3.org/2000/svg";

function drawn(name, attributes) {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  return made;
}

export function range(curves) {
  const values = curves.flat().filter((value) => value !== null);
  const [low, high] = values.reduce(([a, b], v) => [Math.min(a, v), Math.max(b, v)], [Infinity, -Infinity]);
  if (!(low < high)) return [low - 1, high + 1];
  return [low - 0.05 * (high - low), high + 0.05 * (high - low)];
}

// The path of a curve in a box of 100 × 100; steps without a value are left out.
function path(curve, [low, high], n) {
  let pen = "M";
  const points = curve.map((value, step) => {
    if (value === null) return "";
    const point = `${pen}${((100 * step) / Math.max(1, n - 1)).toFixed(2)} ${((100 * (high - value)) / (high - low)).toFixed(2)}`;
    pen = "L";
    return point;
  });
  return points.join("");
}

function canvas(kind) {
  return drawn("svg", { viewBox: "0 0 100 100", preserveAspectRatio: "none", class: kind, "aria-hidden": "true" });
}

function zero(bounds) {
  const [low, high] = bounds;
  const y = (100 * high) / (high - low);
  return low < 0 && high > 0 ? [drawn("line", { x1: 0, x2: 100, y1: y, y2: y, class: "zero" })] : [];
}

export function thumbnail(curve, bounds, n) {
  const svg = canvas("curve");
  svg.append(...zero(bounds), drawn("path", { d: path(curve, bounds, n), class: "line score" }));
  return svg;
}

// A chart of named curves; `onSeek` is called with the step that is pointed at.
export function chart(title, curves, onSeek) {
  const n = Math.max(...curves.map((each) => each.values.length));
  const bounds = range(curves.map((each) => each.values));
  const svg = canvas("plot");
  svg.append(...zero(bounds));
  const cursor = drawn("line", { y1: 0, y2: 100, class: "cursor" });
  const outputs = curves.map(() => element("b"));
  curves.forEach((each) => svg.append(drawn("path", { d: path(each.values, bounds, n), class: `line ${each.kind}` })));
  svg.append(cursor);
  const legend = element("ul", { class: "legend" });
  curves.forEach((each, i) => {
    const key = canvas("key");
    key.append(drawn("path", { d: "M0 50L100 50", class: `line ${each.kind}` }));
    legend.append(element("li", {}, key, ...(each.picture ? [each.picture] : []), `${each.name} `, outputs[i]));
  });
  const box = element("div", { class: "plotted" });
  box.append(
    element("span", { class: "high note" }, digits(bounds[1], 2)),
    element("span", { class: "low note" }, digits(bounds[0], 2)),
    svg,
  );
  const seek = (event) => {
    const at = svg.getBoundingClientRect();
    onSeek(Math.round(((n - 1) * (event.clientX - at.left)) / at.width));
  };
  svg.addEventListener("pointerdown", (event) => {
    svg.setPointerCapture(event.pointerId);
    seek(event);
  });
  svg.addEventListener("pointermove", (event) => svg.hasPointerCapture(event.pointerId) && seek(event));
  return {
    node: element("figure", { class: "chart-of" }, element("h3", {}, title), box, legend),
    move(step) {
      for (const side of ["x1", "x2"]) cursor.setAttribute(side, (100 * step) / Math.max(1, n - 1));
      curves.forEach((each, i) => (outputs[i].textContent = digits(each.values[step])));
    },
  };
}
