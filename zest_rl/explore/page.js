// The page of `zest explore`: the server scores, the page keeps the goal and shows what it is sent.

import { range, thumbnail } from "./charts.js";
import { $, digits, element } from "./elements.js";
import { KEYS, close, mark, open, openEpisode, showCurves, watchEpisode } from "./episode.js";
import { answering, beginWith, count, question, showGoal, watchGoal } from "./goal.js";
import { ask, attempt, tell } from "./server.js";
import { state } from "./state.js";

const DIGITS = { return: 2, worth: 3, end: 3, order: 2, disagreement: 3, true: 2 };

let scorings = 0; // how many have begun
let judged = 0; // on how many episodes the verdict is

// Scores by the goal as it is; the quick answers come first.
async function rescore() {
  const mine = ++scorings;
  $("#save-goal").disabled = $("#save").disabled = question() === null;
  document.body.classList.add("busy", "scoring");
  showGoal();
  try {
    for (const show of [showScores, showCurves, showProposal, showVerdict]) if (mine === scorings) await show();
  } finally {
    if (mine === scorings) document.body.classList.remove("busy", "scoring");
  }
}

const showScores = answering(
  (asked) => [`scores/${state.dataset}`, asked],
  (answer, asked) => {
    state.scored = answer.episodes ?? [];
    count(answer.kept?.map((k) => asked.goals[k]) ?? null);
    showEpisodes();
    document.body.classList.remove("scoring");
  },
);

const showVerdict = answering(
  (asked) => [`verdict/${state.dataset}`, asked],
  (answer, asked) => {
    const note = (...parts) => element("span", { class: "note" }, ...parts);
    const parts = [];
    if (answer.advice) {
      const kind = { "train on it": "yes", "do not": "no" }[answer.advice] ?? "";
      parts.push(element("b", { class: `advice ${kind}` }, answer.advice), ` ${answer.why}`);
      for (const [name, [value, low, high]] of Object.entries(answer.figures)) {
        const interval = low === high ? "" : ` (${digits(low, 2)} to ${digits(high, 2)})`;
        parts.push(note(` · ${name} `, element("b", {}, digits(value, 2)), interval));
      }
      if (state.scored.length < state.facts.steps.length)
        parts.push(note(` · of the ${state.scored.length} episodes that are ready`));
    } else if (asked) {
      parts.push(note("A reward is judged on at least 3 episodes."));
    }
    const warnings = answer.warnings ?? [];
    judged = state.scored.length;
    $("#verdict").replaceChildren(...parts);
    $("#warnings").replaceChildren(...warnings.map((text) => element("li", {}, text)));
    $("#warnings").hidden = !warnings.length;
  },
);

// All episodes --------------------------------------------------------------------------------------------------------

function figure(each, by) {
  return by === "true" ? state.facts.true_returns[each.episode] : each[by];
}

function sorted() {
  const by = $("#sort").value;
  if (!state.scored.length) return state.facts.steps.map((_, episode) => ({ episode }));
  if (by === "episode") return state.scored;
  return [...state.scored].sort((a, b) => figure(b, by) - figure(a, by) || a.episode - b.episode);
}

function showEpisodes() {
  const bounds = range(state.scored.map((each) => each.curve));
  const longest = Math.max(...state.facts.steps) + 1;
  const by = $("#sort").value === "episode" ? "return" : $("#sort").value;
  const cells = sorted().map((each) => {
    const name = element("span", {}, each.episode);
    const success = state.facts.success?.[each.episode];
    if (success === true) name.append(element("i", { class: "yes", title: "success" }, "✓"));
    if (success === false) name.append(element("i", { class: "no", title: "failure" }, "✗"));
    const value = each.curve ? digits(figure(each, by), DIGITS[by]) : "";
    const cell = element(
      "button",
      { class: "cell" },
      element("span", { class: "head" }, name, element("b", {}, value)),
      each.curve ? thumbnail(each.curve, bounds, longest) : element("span", { class: "curve" }),
    );
    cell.dataset.episode = each.episode;
    cell.addEventListener("click", () => attempt(() => open(each.episode)));
    return cell;
  });
  $("#episodes").replaceChildren(...cells);
  $("#hint").hidden = state.scored.length > 0;
  mark();
  showDropped();
}

function openNext(by) {
  const order = sorted().map((each) => each.episode);
  const at = openEpisode() === undefined ? (by > 0 ? -1 : order.length) : order.indexOf(openEpisode());
  const next = order[at + by];
  if (next === undefined) return;
  attempt(() => open(next));
  $(`.cell[data-episode="${next}"]`).scrollIntoView({ block: "nearest" });
}

// Episodes to drop ----------------------------------------------------------------------------------------------------

const showProposal = answering(
  (asked) => [`proposal/${state.dataset}`, { ...asked, keep: Number($("#keep").value) }],
  (answer) => {
    state.dropped = answer.dropped ?? [];
    $("#proposal").hidden = !answer.dropped;
    $("#proposal output").textContent = `${Math.round(100 * $("#keep").value)} %`;
    const hint = element("p", { class: "note" }, "Save as relabeled dataset, and the command that drops them stands here.");
    $("#proposal .command").replaceChildren(answer.command ? element("pre", {}, answer.command) : hint);
    showDropped();
  },
);

function showDropped() {
  const rows = sorted().filter((each) => state.dropped.includes(each.episode));
  if ($("#sort").value !== "episode") rows.reverse(); // the worst first
  const failed = (each) => state.facts.success?.[each.episode] === false;
  const [found, all] = [rows, state.scored].map((episodes) => episodes.filter(failed).length);
  const failures = all ? `, among them ${found} of ${all} failures` : "";
  $("#proposal summary b").textContent = `${rows.length} of ${state.scored.length}${failures}`;
  $("#proposal tbody").replaceChildren(
    ...rows.map((each) => {
      const button = element("button", {}, each.episode);
      button.addEventListener("click", () => attempt(() => open(each.episode)));
      const worth = element("td", { class: "num" }, digits(each.worth));
      return element("tr", {}, element("td", {}, button), worth, element("td", {}, each.words));
    }),
  );
  for (const cell of document.querySelectorAll(".cell"))
    cell.classList.toggle("dropped", state.dropped.includes(Number(cell.dataset.episode)));
}

// Saving --------------------------------------------------------------------------------------------------------------

async function save(what, name) {
  $("#saved").replaceChildren(element("p", { class: "note" }, "saving …"));
  const answer = await ask(`${what}/${state.dataset}`, question());
  $("#saved").replaceChildren(
    element("p", {}, `${name} `, element("b", {}, answer[name])),
    element("p", { class: "note" }, name === "dataset" ? "The same by a command:" : "To relabel by it:"),
    element("pre", {}, answer.command),
  );
  await showProposal();
}

// The dataset ---------------------------------------------------------------------------------------------------------

async function refresh(of) {
  if (of !== state.dataset) return;
  const facts = await ask(`state/${of}`);
  if (of !== state.dataset) return;
  const [all, isNew] = [facts.steps.length, facts.ready > state.facts.ready];
  state.facts = facts;
  $("#bar").hidden = facts.ready === all;
  $("#bar progress").value = facts.ready / all;
  const ready = `${facts.ready} of ${all} episodes are embedded; these can be scored`;
  $("#bar .note").textContent = facts.problem ? `${ready}. ${facts.problem}` : ready;
  const waits = facts.ready === all || !isNew;
  if (question() && !waits) await showScores();
  if (question() && waits && judged < facts.ready) await rescore();
  const goesOn = facts.ready < all && (isNew || !facts.problem);
  if (goesOn) setTimeout(() => refresh(of).catch(tell), isNew ? 50 : 250);
}

async function start(index) {
  close();
  const facts = await ask(`state/${index}`);
  Object.assign(state, { dataset: index, facts, scored: [], dropped: [] });
  const names = facts.datasets.map((name, i) => element("option", { value: i, selected: i === index }, name));
  $("#dataset").replaceChildren(...names);
  $("#dataset").disabled = names.length < 2;
  $("#sentences").hidden = !facts.reads_text;
  $("#sort [value=true]").hidden = facts.true_returns === null;
  if (facts.true_returns === null && $("#sort").value === "true") $("#sort").value = "return";
  $("#episode .view").replaceChildren(...facts.views.map((name, i) => element("option", { value: i }, `${i + 1}: ${name}`)));
  $("#episode .view").value = Math.floor(facts.views.length / 2);
  if (facts.goal) beginWith(facts.goal);
  await rescore();
  await refresh(index);
}

watchGoal(() => {
  $("#saved").replaceChildren();
  return rescore();
});
watchEpisode();
$("#sort").addEventListener("change", showEpisodes);
$("#keep").addEventListener("input", () => attempt(showProposal));
$("#save-goal").addEventListener("click", () => attempt(() => save("goal", "goal")));
$("#save").addEventListener("click", () => attempt(() => save("save", "dataset")));
$("#dataset").addEventListener("change", (event) => attempt(() => start(Number(event.target.value))));
document.addEventListener("keydown", (event) => {
  const keys = { ...KEYS, j: () => openNext(1), k: () => openNext(-1) };
  const typing = event.target.matches("select, input:not([type=range]):not([type=checkbox]), #switches input, #keep");
  const pressing = event.key === " " && event.target.matches("button, summary, input");
  if (typing || pressing || event.ctrlKey || event.metaKey || event.altKey || !(event.key in keys)) return;
  event.preventDefault();
  keys[event.key]();
});
attempt(() => start(0));
