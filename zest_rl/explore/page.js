// The page of `zest explore`. The server scores; the page keeps the goal, and shows what it is sent.

import { chart, element, range, shown, thumbnail } from "./charts.js";

const $ = (selector) => document.querySelector(selector);
const KINDS = ["c0", "c1", "c2", "c3", "c4", "c5"];
const DIGITS = { return: 2, end: 3, order: 2, disagreement: 3, true: 2 };

let dataset = 0;
let facts = null; // what `state` answered
let goal = { starts: [], goals: [], sentences: false }; // of pictures: { name, on }
let scored = []; // of each episode that is ready: curve and figures
let kept = null;
let opened = null; // { episode, step, charts }
let asked = 0; // the last question wins

async function ask(path, body, type = "application/json") {
  const request = body === undefined ? {} : { method: "POST", body, headers: { "content-type": type } };
  const response = await fetch(path, request);
  const answer = await response.json().catch(() => ({ error: "the server does not answer as it should" }));
  if (!response.ok) throw new Error(answer.error);
  return answer;
}

function tell(error) {
  $("#problem").textContent = error ? error.message ?? error : "";
  $("#problem").hidden = !error;
}

const attempt = (work) => work().then(() => tell(null), tell);

// The goal ------------------------------------------------------------------------------------------------------------

function question() {
  const on = (side) => goal[side].filter((picture) => picture.on).map((picture) => picture.name);
  const field = (name) => $(`#switches [name=${name}]`).value;
  const asked = {
    starts: on("starts"),
    goals: on("goals"),
    are_sentences: goal.sentences,
    features: field("features"),
    similarity: field("similarity"),
    reward: field("reward"),
    goal_share: Number(field("goal_share")),
  };
  return asked.starts.length && asked.goals.length ? JSON.stringify(asked) : null;
}

function add(side, names) {
  if (goal.sentences) goal = { starts: [], goals: [], sentences: false };
  for (const name of names) {
    if (!goal[side].some((picture) => picture.name === name)) goal[side].push({ name, on: true });
  }
  return changed();
}

function picture(name) {
  return goal.sentences ? element("q", {}, name) : element("img", { src: `pictures/${name}`, alt: "" });
}

function showGoal() {
  for (const side of ["starts", "goals"]) {
    const shown = goal[side].map((item, i) => {
      const label = `${side === "starts" ? "start" : "goal"} ${i + 1}`;
      const button = element("button", { class: "picture", title: `${label}: switch on or off` }, picture(item.name));
      button.setAttribute("aria-pressed", item.on);
      button.setAttribute("aria-label", label);
      button.addEventListener("click", () => {
        item.on = !item.on;
        attempt(changed);
      });
      const remove = element("button", { class: "remove", title: "remove" }, "×");
      remove.setAttribute("aria-label", `remove ${label}`);
      remove.addEventListener("click", () => {
        goal[side].splice(i, 1);
        attempt(changed);
      });
      const counts = side === "starts" || !item.on || !kept || kept.has(item.name);
      return element("div", { class: counts ? "held" : "held left-out" }, button, remove);
    });
    $(`#${side} .pictures`).replaceChildren(...shown);
  }
}

async function upload(side, files) {
  const pictures = [...files].filter((file) => file.type.startsWith("image/"));
  if (!pictures.length) throw new Error("drop pictures here: JPEG, PNG, WebP, BMP, GIF or TIFF files");
  const answers = await Promise.all(pictures.map((file) => ask("pictures", file, file.type)));
  await add(side, answers.flatMap((answer) => answer.names));
}

for (const side of ["starts", "goals"]) {
  const zone = $(`#${side}`);
  zone.addEventListener("dragover", (event) => {
    event.preventDefault();
    zone.classList.add("over");
  });
  zone.addEventListener("dragleave", () => zone.classList.remove("over"));
  zone.addEventListener("drop", (event) => {
    event.preventDefault();
    zone.classList.remove("over");
    attempt(() => upload(side, event.dataTransfer.files));
  });
  zone.querySelector("input").addEventListener("change", (event) => {
    const files = [...event.target.files];
    event.target.value = "";
    attempt(() => upload(side, files));
  });
}
document.addEventListener("paste", (event) => {
  if (!event.clipboardData.files.length) return;
  const focused = document.activeElement.closest(".drop")?.id;
  attempt(() => upload(focused ?? (goal.starts.length ? "goals" : "starts"), event.clipboardData.files));
});
$("#sentences").addEventListener("submit", (event) => {
  event.preventDefault();
  const [start, end] = ["start", "goal"].map((name) => $(`#sentences [name=${name}]`).value.trim());
  goal = { starts: [{ name: start, on: true }], goals: [{ name: end, on: true }], sentences: true };
  attempt(changed);
});
$("#switches").addEventListener("input", () => {
  const own = !["delta", "raw"].includes($("[name=features]").value); // such features bring their own similarity
  if (own) $("[name=similarity]").value = "cos";
  $("[name=similarity]").disabled = own;
  $("#switches output").textContent = $("[name=goal_share]").value;
  attempt(changed);
});

// Scores --------------------------------------------------------------------------------------------------------------

async function changed() {
  const [asks, turn, of] = [question(), ++asked, dataset];
  $("#saved").replaceChildren();
  $("#save-goal").disabled = $("#save").disabled = asks === null;
  document.body.classList.toggle("busy", asks !== null);
  if (asks === null) [scored, kept] = [[], null];
  showGoal();
  try {
    if (asks !== null) {
      const answer = await ask(`scores/${of}`, asks);
      if (turn !== asked) return;
      scored = answer.episodes;
      const goals = JSON.parse(asks).goals;
      kept = new Set(answer.kept.map((k) => goals[k]));
      showGoal();
    }
    showEpisodes();
    await showCurves();
    if (turn === asked) await showVerdict(asks, of, turn);
  } finally {
    if (turn === asked) document.body.classList.remove("busy");
  }
}

async function showVerdict(asks, of, turn) {
  const answer = asks === null ? {} : await ask(`verdict/${of}`, asks);
  if (turn !== asked) return;
  const parts = [];
  if (answer.advice) {
    const kind = { "train on it": "yes", "do not": "no" }[answer.advice] ?? "";
    parts.push(element("b", { class: `advice ${kind}` }, answer.advice), ` ${answer.why}`);
    for (const [name, [value, low, high]] of Object.entries(answer.figures)) {
      const interval = low === high ? "" : ` (${shown(low, 2)} to ${shown(high, 2)})`;
      parts.push(element("span", { class: "note" }, ` · ${name} `, element("b", {}, shown(value, 2)), interval));
    }
    if (scored.length < facts.steps.length)
      parts.push(element("span", { class: "note" }, ` · of the ${scored.length} episodes that are ready`));
  } else if (asks !== null) {
    parts.push(element("span", { class: "note" }, "A reward is judged on at least 3 episodes."));
  }
  $("#verdict").replaceChildren(...parts);
  $("#warnings").replaceChildren(...(answer.warnings ?? []).map((text) => element("li", {}, text)));
  $("#warnings").hidden = !(answer.warnings ?? []).length;
}

function sorted() {
  const by = $("#sort").value;
  const value = (each) => (by === "true" ? facts.true_returns[each.episode] : each[by]) ?? -Infinity;
  const rows = scored.length ? scored : facts.steps.map((_, episode) => ({ episode }));
  if (by === "episode" || !scored.length) return rows;
  return [...rows].sort((a, b) => value(b) - value(a) || a.episode - b.episode);
}

function showEpisodes() {
  const bounds = range(scored.map((each) => each.curve));
  const longest = Math.max(...facts.steps) + 1;
  const by = $("#sort").value;
  const cells = sorted().map((each) => {
    const cell = element("button", { class: "cell" });
    cell.dataset.episode = each.episode;
    const success = facts.success?.[each.episode];
    const figure = by === "true" ? facts.true_returns[each.episode] : by === "episode" ? each.return : each[by];
    const name = element("span", {}, `${each.episode}`);
    if (success !== null && success !== undefined)
      name.append(element("i", { class: success ? "yes" : "no", title: success ? "success" : "failure" }, success ? "✓" : "✗"));
    const head = element("span", { class: "head" }, name, element("b", {}, each.curve ? shown(figure, DIGITS[by] ?? 2) : ""));
    cell.append(head, each.curve ? thumbnail(each.curve, bounds, longest) : element("span", { class: "curve" }));
    cell.addEventListener("click", () => attempt(() => open(each.episode)));
    return cell;
  });
  $("#episodes").replaceChildren(...cells);
  $("#hint").hidden = scored.length > 0;
  mark();
}

function mark() {
  for (const cell of document.querySelectorAll(".cell"))
    cell.setAttribute("aria-current", opened !== null && Number(cell.dataset.episode) === opened.episode);
}

$("#sort").addEventListener("change", showEpisodes);

// An episode ----------------------------------------------------------------------------------------------------------

async function open(episode) {
  stop();
  opened = { episode, step: 0, charts: [] };
  const success = { true: ", a success", false: ", a failure" }[facts.success?.[episode]] ?? "";
  $("#episode h2").textContent = `Episode ${episode}`;
  $("#episode .facts").textContent = `${facts.steps[episode]} steps${success}`;
  $("#episode .step").max = facts.steps[episode];
  $("#episode").hidden = false;
  mark();
  show(0);
  await showCurves();
  if (innerWidth < 900) $("#episode").scrollIntoView({ block: "start" });
}

async function showCurves() {
  if (opened === null) return;
  const [asks, episode] = [question(), opened.episode];
  let answer = { scores: null };
  if (asks !== null && scored.some((each) => each.episode === episode)) answer = await ask(`curves/${dataset}/${episode}`, asks);
  if (opened?.episode !== episode) return;
  const goals = goal.goals.filter((each) => each.on);
  const charts = [];
  if (answer.scores) {
    charts.push(chart("Score", [{ name: "all together", kind: "score", values: answer.scores }], seek));
    if (answer.by_goal.length > 1) {
      const curves = answer.by_goal.map((values, k) => ({ name: `goal ${k + 1}`, kind: KINDS[k % 6], values, picture: picture(goals[k].name) }));
      charts.push(chart("By each goal picture alone", curves, seek));
    }
    if (answer.by_view.length > 1) {
      const curves = answer.by_view.map((values, v) => ({ name: `view ${v + 1}`, kind: KINDS[v % 6], values }));
      charts.push(chart("By each view alone", curves, seek));
    }
    if (answer.truth) charts.push(chart("Recorded reward or ground truth, which no score uses", [{ name: "recorded", kind: "gt", values: answer.truth }], seek));
  }
  opened.charts = charts;
  $("#episode .charts").replaceChildren(...charts.map((each) => each.node));
  charts.forEach((each) => each.move(opened.step));
}

function frame(step) {
  return `frames/${dataset}/${opened.episode}/${step}/${$("#episode .view").value}`;
}

function show(step) {
  const last = facts.steps[opened.episode];
  opened.step = Math.min(Math.max(step, 0), last);
  $("#episode img").src = frame(opened.step);
  $("#episode img").alt = `episode ${opened.episode} at step ${opened.step}`;
  $("#episode .step").value = opened.step;
  $("#episode .at").textContent = `step ${opened.step} of ${last}`;
  opened.charts.forEach((each) => each.move(opened.step));
}

function seek(step) {
  stop();
  show(step);
}

let playing = null;

function stop() {
  playing = null;
  $("#episode .play").textContent = "▶ Play";
}

// Plays as fast as frames come, and no faster than they were recorded.
async function play() {
  if (playing !== null) return stop();
  const turn = (playing = {});
  $("#episode .play").textContent = "❚❚ Pause";
  if (opened.step === facts.steps[opened.episode]) show(0);
  while (playing === turn && opened.step < facts.steps[opened.episode]) {
    const wait = new Promise((done) => setTimeout(done, 1000 / facts.fps));
    const next = Object.assign(new Image(), { src: frame(opened.step + 1) });
    await Promise.all([next.decode().catch(() => {}), wait]);
    if (playing === turn) show(opened.step + 1);
  }
  if (playing === turn) stop();
}

function close() {
  stop();
  opened = null;
  $("#episode").hidden = true;
  mark();
}

function step(by) {
  const order = sorted().map((each) => each.episode);
  const at = opened === null ? (by > 0 ? -1 : order.length) : order.indexOf(opened.episode);
  const next = order[at + by];
  if (next === undefined) return;
  attempt(() => open(next));
  document.querySelector(`.cell[data-episode="${next}"]`)?.scrollIntoView({ block: "nearest" });
}

async function take(side) {
  const view = $("#episode .all").checked ? null : Number($("#episode .view").value);
  const answer = await ask(`take/${dataset}/${opened.episode}/${opened.step}`, JSON.stringify({ view }));
  await add(side, answer.names);
}

$("#episode .step").addEventListener("input", (event) => seek(Number(event.target.value)));
$("#episode .view").addEventListener("change", () => seek(opened.step));
$("#episode .play").addEventListener("click", () => attempt(play));
$("#episode .close").addEventListener("click", close);
for (const button of document.querySelectorAll(".take"))
  button.addEventListener("click", () => attempt(() => take(button.dataset.side)));

const KEYS = {
  j: () => step(1),
  k: () => step(-1),
  ArrowRight: () => opened && seek(opened.step + 1),
  ArrowLeft: () => opened && seek(opened.step - 1),
  " ": () => opened && attempt(play),
  s: () => opened && attempt(() => take("starts")),
  g: () => opened && attempt(() => take("goals")),
  Escape: close,
};
document.addEventListener("keydown", (event) => {
  const typing = event.target.matches("select, input:not([type=range]):not([type=checkbox])");
  const pressing = event.key === " " && event.target.matches("button, summary, input");
  if (typing || pressing || event.ctrlKey || event.metaKey || event.altKey || !(event.key in KEYS)) return;
  if (event.target.matches("#switches input")) return;
  event.preventDefault();
  KEYS[event.key]();
});

// Saving --------------------------------------------------------------------------------------------------------------

async function save(what, name) {
  $("#saved").replaceChildren(element("p", { class: "note" }, "saving …"));
  const answer = await ask(`${what}/${dataset}`, question());
  $("#saved").replaceChildren(
    element("p", {}, `${name} `, element("b", {}, answer.dataset ?? answer.goal)),
    element("p", { class: "note" }, answer.dataset ? "The same on a command line:" : "To relabel by it:"),
    element("pre", {}, answer.command),
  );
}
$("#save-goal").addEventListener("click", () => attempt(() => save("goal", "goal")));
$("#save").addEventListener("click", () => attempt(() => save("save", "dataset")));

// The dataset ---------------------------------------------------------------------------------------------------------

async function refresh(of) {
  if (of !== dataset) return;
  const before = facts.ready;
  const answer = await ask(`state/${of}`);
  if (of !== dataset) return;
  facts = answer;
  const all = facts.steps.length;
  $("#bar").hidden = facts.ready === all;
  $("#bar progress").value = facts.ready / all;
  const ready = `${facts.ready} of ${all} episodes are embedded; these can be scored`;
  $("#bar .note").textContent = facts.problem ? `${ready}. ${facts.problem}` : ready;
  if (facts.ready > before && question() !== null) await changed();
  const isOver = facts.ready === all || (facts.problem && facts.ready === before);
  if (!isOver) setTimeout(() => attempt(() => refresh(of)), facts.ready > before ? 50 : 250);
}

async function start(index) {
  close();
  [dataset, facts, scored] = [index, null, []];
  facts = await ask(`state/${index}`);
  const names = facts.datasets.map((name, i) => element("option", { value: i, selected: i === index }, name));
  $("#dataset").replaceChildren(...names);
  $("#dataset").disabled = names.length < 2;
  $("#sentences").hidden = !facts.reads_text;
  $("#sort [value=true]").hidden = facts.true_returns === null;
  $("#episode .view").replaceChildren(...facts.views.map((name, i) => element("option", { value: i }, `${i + 1}: ${name}`)));
  $("#episode .view").value = Math.floor(facts.views.length / 2);
  if (facts.goal && !goal.starts.length && !goal.goals.length) {
    const held = (names) => names.map((name) => ({ name, on: true }));
    goal = { starts: held(facts.goal.starts), goals: held(facts.goal.goals), sentences: facts.goal.are_sentences };
  }
  facts.ready = 0;
  showEpisodes();
  await changed();
  facts.ready = scored.length;
  await refresh(index);
}
$("#dataset").addEventListener("change", (event) => attempt(() => start(Number(event.target.value))));
attempt(() => start(0));
