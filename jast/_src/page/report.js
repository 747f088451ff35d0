// the cards of a report: traces, and a slider through the episode
const COLOURS = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9"];
const WIDTH = 320, HEIGHT = 120, LEFT = 58, RIGHT = 8, TOP = 8, BOTTOM = 20;

// "x,y x,y ..." for each stretch of finite numbers
function stretches(xs, ys, x, y) {
  const found = [[]];
  xs.forEach((at, i) => {
    const value = ys[i] === null || ys[i] === undefined ? NaN : Number(ys[i]);
    if (Number.isFinite(value)) found[found.length - 1].push([x(at), y(value)]);
    else found.push([]);
  });
  return found.filter((points) => points.length);
}

function lines(svg, xs, ys, x, y, attributes) {
  for (const points of stretches(xs, ys, x, y)) {
    const places = points.map((p) => p.map((v) => v.toFixed(1)).join(",")).join(" ");
    svg.append(points.length > 1
      ? make("polyline", { points: places, fill: "none", ...attributes })
      : make("circle", { cx: points[0][0], cy: points[0][1], r: 2, fill: attributes.stroke }));
  }
}

// a figure of columns over the steps; returns it and a function that moves its cursor
function panel(name, entries, columns, quiet, steps, marked = []) {
  const all = [...columns, ...quiet].flat().filter((v) => v !== null).map(Number)
    .filter(Number.isFinite);
  let low = all.reduce((a, b) => Math.min(a, b), Infinity);
  let high = all.reduce((a, b) => Math.max(a, b), -Infinity);
  if (low > high) [low, high] = [0, 1];
  if (low === high) [low, high] = [low - 0.5 * (Math.abs(low) || 1), high + 0.5 * (Math.abs(high) || 1)];
  const last = Math.max(steps[steps.length - 1], 1);
  const x = (t) => LEFT + (WIDTH - LEFT - RIGHT) * t / last;
  const y = (v) => TOP + (HEIGHT - TOP - BOTTOM) * (high - v) / (high - low);
  const svg = make("svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: "img", "aria-label": name });
  for (const v of [low, high]) {
    svg.append(make("line", { x1: LEFT, x2: WIDTH - RIGHT, y1: y(v), y2: y(v), stroke: "#e6e6e6" }));
    svg.append(make("text", { x: LEFT - 5, y: y(v) + 4, "text-anchor": "end", "font-size": 11,
      fill: "#666" }, words(v, 3)));
  }
  for (const t of [0, last]) {
    svg.append(make("text", { x: x(t), y: HEIGHT - 5, "text-anchor": t ? "end" : "start",
      "font-size": 11, fill: "#666" }, t ? `step ${t}` : "0"));
  }
  quiet.forEach((column) => lines(svg, steps, column, x, y,
    { stroke: "#999", "stroke-width": 1.2, "stroke-dasharray": "4 3" }));
  columns.forEach((column, i) => lines(svg, steps, column, x, y,
    { stroke: COLOURS[i % COLOURS.length], "stroke-width": 1.8 }));
  marked.forEach((t) => svg.append(make("circle",
    { cx: x(t), cy: HEIGHT - BOTTOM, r: 3, fill: "#b84a00", class: "needed" })));
  const cursor = make("line", { y1: TOP, y2: HEIGHT - BOTTOM, stroke: "#222", class: "cursor" });
  svg.append(cursor);
  const caption = make("figcaption", {}, name);
  if (columns.length > 1) {
    entries.forEach((entry, i) => caption.append(" ", make("span",
      { style: `color:${COLOURS[i % COLOURS.length]}` }, entry)));
  }
  const move = (t) => { cursor.setAttribute("x1", x(t)); cursor.setAttribute("x2", x(t)); };
  return [make("figure", {}, caption, svg), move];
}

// the numbers of one step: rows of name, value
function table(mode, i) {
  const body = make("tbody");
  const line = (name, value, undisturbed) => body.append(make("tr", {}, make("td", {}, name),
    make("td", { class: "number" }, words(value)),
    make("td", { class: "number" }, words(undisturbed))));
  const part = (title, groups, quiet, at = i) => {
    if (!groups || !groups.length) return;
    body.append(make("tr", {}, make("th", { colspan: 3 }, title)));
    groups.forEach((group, g) => {
      group.columns.forEach((column, j) =>
        line(group.name + group.entries[j], column[at], quiet ? quiet[g][j][i] : null));
      if (group.more) line(`${group.name}: ${group.more} more numbers`, null, null);
    });
  };
  part("state", mode.states, mode.quiet);
  if (mode.distance) line("miss distance", mode.distance[i], null);
  if (mode.risk) line("probability of failing from here", mode.risk[i], null);
  if (mode.steps[i]) part("disturbance of this step", mode.x, null);
  else part("disturbance of the start", mode.x0, null, 0);
  return make("table", {}, make("thead", {}, make("tr", {}, make("th", {}, "name"),
    make("th", {}, "value"), make("th", {}, mode.quiet ? "undisturbed" : ""))), body);
}

function card(article) {
  const mode = data.modes[Number(article.dataset.mode)];
  const find = (name) => article.querySelector(`.${name}`);
  const moves = [], traces = find("traces");
  const add = (name, entries, columns, quiet, marked) => {
    const [figure, move] = panel(name, entries, columns, quiet, mode.steps, marked);
    traces.append(figure);
    moves.push(move);
  };
  const few = COLOURS.length;
  (mode.states || []).forEach((group, g) => add(group.name, group.entries.slice(0, few),
    group.columns.slice(0, few), mode.quiet ? mode.quiet[g].slice(0, few) : []));
  if (mode.distance) add("miss distance", [""], [mode.distance], []);
  mode.x.forEach((group) => add(`disturbance ${group.name}`, group.entries.slice(0, few),
    group.columns.slice(0, few), [], mode.needed && mode.needed[group.name]));
  if (mode.risk) {
    add("probability of failing from here (dashed: its interval)", [""], [mode.risk], mode.interval);
  }
  (mode.directions || []).forEach((way) => way.panels.forEach((p) => traces.append(panel(
    `${way.name}: ${p.name} (dashed: the mean failure)`, ["at -1", "at +1"], p.columns, p.quiet,
    way.steps)[0])));
  if (mode.needed) traces.append(make("p", { class: "legend" }, "dots: disturbances that are needed"));
  if (mode.quiet) traces.append(make("p", { class: "legend" }, "dashed: the undisturbed system"));

  const slider = find("slider"), picture = find("picture");
  const frame = mode.pictures ? picture.attachShadow({ mode: "open" }) : null;
  picture.hidden = !mode.pictures;
  const show = () => {
    const i = Number(slider.value);
    find("step").textContent = `${mode.steps[i]} of ${mode.length}`;
    find("numbers").replaceChildren(table(mode, i));
    moves.forEach((move) => move(mode.steps[i]));
    // the picture is HTML of the user's own, in a room of its own
    if (frame) frame.innerHTML = mode.pictures.fragments[mode.pictures.at[i]];
  };
  slider.addEventListener("input", show);
  show();

  let clock = null;
  const play = find("play");
  const stop = () => { clearInterval(clock); clock = null; play.textContent = "Play"; };
  play.addEventListener("click", () => {
    if (clock) { stop(); return; }
    if (slider.value === slider.max) slider.value = 0;
    show();
    play.textContent = "Stop";
    clock = setInterval(() => {
      if (slider.value === slider.max) { stop(); return; }
      slider.value = Number(slider.value) + 1;
      show();
    }, Math.max(30, Math.min(400, 6000 / mode.steps.length)));
  });

  if (!mode.exact) return;
  const text = mode.exact; // a text: a number of JavaScript has no -0 in JSON, nor 64-bit integers
  find("json").textContent = text;
  find("copy").addEventListener("click", (event) => copy(text, event.target));
  find("download").addEventListener("click", () => download(`${mode.name}.json`, text));
}

document.querySelectorAll(".card").forEach(card);
document.querySelectorAll("#replay .code").forEach((code) =>
  code.querySelector(".copy").addEventListener("click", (event) =>
    copy(code.querySelector("pre").textContent, event.target)));
