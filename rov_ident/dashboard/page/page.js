// Draws what the server sends twice a second; asks for nothing and changes nothing.
"use strict";

const RECENT_BINS = 20;                // the last ten seconds of them
const BINS = 240;                      // of residuals, as the server keeps them
const POINTS = 300;                    // of a curve
const CELL = 12;                       // px; the least in which a name can stand
const EXCITED = 0.05;                  // share of the prior variance from which a motion shows it
const AXES = ["X", "Y", "Z", "K", "M", "N"];
const STATES = {                       // word: sign and level, as in core/states.py
  "converged": ["✓", 0], "converging": ["…", 1], "held": ["–", 1], "at bound": ["!", 2],
  "diverged": ["✕", 2], "stale": ["○", 3],
};
const COLOURS = ["good", "fair", "bad", "none"];  // of levels
const HEALTH = ["ok", "warning", "error", "stale"];

const estimators = new Map();          // by full name: the latest state, with history and residuals
let bridges = {};                      // to controllers: the last status of each
let chosen = null;                     // namespace
let built = "";                        // what the present elements were made for
let updates = [];                      // functions that bring the elements up to date
let recent = 0;                        // s of the history to show; 0: all
let cursor = null;                     // s before the end, under the pointer

// ---------------------------------------------------------------- small helpers

function element(parent, tag, className, text) {
  const node = document.createElement(tag);
  if (className) node.className = className;
  if (text !== undefined) node.textContent = text;
  parent?.append(node);
  return node;
}

function drawing(parent, tag, attributes) {
  const node = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  parent?.append(node);
  return node;
}

const namespaceOf = (name) => name.slice(0, name.lastIndexOf("/")) || "/";
const shortName = (name) => name.slice(name.lastIndexOf("/") + 1).replace(/_node$/, "");
const colour = (index) => `var(--colour-${index % 4})`;
const dashed = (index) => index % 2 ? "dashed" : "";  // or one curve would hide the other
const signed = (text) => text.replace(/^-(?=[0.]+$)/, "").replace("-", "−");  // nothing is minus zero

function written(value, std) {         // two digits of the standard deviation decide
  if (value === null || value === undefined) return "–";
  if (!(std > 0)) return signed(value.toPrecision(4));
  const digits = 1 - Math.floor(Math.log10(1.96 * std));
  if (digits > 8 || Math.abs(value) >= 1e6) return signed(value.toPrecision(4));
  return signed(value.toFixed(Math.max(0, digits)));
}

function interval(std) {
  const text = std > 0 ? (1.96 * std).toPrecision(2) : "0";
  return text.includes("e+") && std < 1e6 ? String(Number(text)) : signed(text.replace("e+", "e"));
}

function duration(seconds) {
  if (seconds < 120) return `${Math.round(seconds)} s`;
  if (seconds < 7200) return `${Math.round(seconds / 60)} min`;
  return `${(seconds / 3600).toFixed(1)} h`;
}

function ticks(low, high) {            // two or three round numbers
  const step = 10 ** Math.floor(Math.log10((high - low) / 2));
  const width = [5, 2, 1].map((factor) => factor * step).find((w) => (high - low) / w >= 2) ?? step;
  const found = [];
  for (let k = Math.ceil(low / width); k * width <= high; k++) found.push(k * width);
  return { found, digits: Math.max(0, -Math.floor(Math.log10(width))) };
}

const tenths = (number) => Math.round(10 * number) / 10;

function thinned(rows) {               // no more than there are pixels; with the last one
  const step = Math.ceil(rows.length / POINTS);
  return step < 2 ? rows : rows.filter((_, i) => (rows.length - 1 - i) % step === 0);
}

function path(points) {
  return points.length ? "M" + points.map(([x, y]) => `${tenths(x)},${tenths(y)}`).join("L") : "";
}

function ring(above, below) {
  return above.length ? path(above.concat(below.reverse())) + "Z" : "";
}

// ---------------------------------------------------------------- a picture over time

const widths = new ResizeObserver((entries) => {
  for (const { target, contentRect } of entries) (target.picture ?? {}).width = contentRect.width || 280;
  refresh();
});

class Picture {
  // Bands and curves of all estimators over one time axis; as wide as its card.
  constructor(parent, names, label, height) {
    this.height = height;
    this.svg = drawing(parent, "svg", { role: "img", "aria-label": label, height });
    this.width = 280;
    widths.observe(this.svg);          // asking for it while drawing would lay out the page each time
    this.svg.picture = this;
    this.grid = drawing(this.svg, "path", { class: "axis" });
    this.zero = drawing(this.svg, "path", { class: "zero" });
    this.bands = names.map((_, i) => drawing(this.svg, "path", { class: "band", fill: colour(i) }));
    this.curves = names.map((_, i) => drawing(this.svg, "path",
      { class: `curve ${dashed(i)}`, stroke: colour(i) }));
    this.line = drawing(this.svg, "path", { class: "cursor" });
    this.labels = drawing(this.svg, "g", {});
    const move = (event) => {
      const box = this.svg.getBoundingClientRect();
      const share = (event.clientX - box.left - this.left) / (box.width - this.left - 4);
      cursor = share >= 0 && share <= 1 ? (1 - share) * this.span : null;
      refresh();
    };
    this.svg.addEventListener("pointermove", move);
    this.svg.addEventListener("pointerdown", move);
    this.svg.addEventListener("pointerleave", () => { cursor = null; refresh(); });
  }

  // rows: of each estimator [[t, middle, low, high], ...]; low and high may be null
  draw(rows, start, end, low, high) {
    const width = this.width, bottom = this.height - 16;
    if (!(high > low)) { const pad = Math.abs(low) * 0.1 || 1; low -= pad; high += pad; }
    const { found, digits } = ticks(low, high);
    const texts = found.map((value) => signed(
      Math.abs(value) >= 1e4 || digits > 4 ? value.toExponential(0) : value.toFixed(digits)));
    this.left = 8 + 6.6 * Math.max(...texts.map((text) => text.length), 1);
    this.span = Math.max(end - start, 1e-3);
    const x = (t) => this.left + (t - start) / this.span * (width - this.left - 4);
    const y = (v) => 6 + (high - Math.min(high, Math.max(low, v))) / (high - low) * (bottom - 10);
    this.svg.setAttribute("viewBox", `0 0 ${width} ${this.height}`);
    this.grid.setAttribute("d", found.map((v) => `M${this.left},${y(v).toFixed(1)}H${width - 4}`).join(""));
    this.zero.setAttribute("d", low <= 0 && high >= 0 ? `M${this.left},${y(0).toFixed(1)}H${width - 4}` : "");
    this.labels.replaceChildren();
    const write = (text, px, py, anchor) => {
      drawing(this.labels, "text", { x: px, y: py, "text-anchor": anchor }).textContent = text;
    };
    found.forEach((v, i) => write(texts[i], this.left - 4, y(v) + 4, "end"));
    write(`−${duration(this.span)}`, this.left, this.height - 3, "start");
    write("now", width - 4, this.height - 3, "end");
    rows.forEach((points, i) => {
      const shown = thinned(points.filter(([t, middle]) => t >= start && middle !== null));
      this.curves[i].setAttribute("d", path(shown.map(([t, v]) => [x(t), y(v)])));
      const banded = shown.filter(([, , lowest, highest]) => lowest !== null && highest !== null);
      this.bands[i].setAttribute("d", ring(
        banded.map(([t, , , highest]) => [x(t), y(highest)]),
        banded.map(([t, , lowest]) => [x(t), y(lowest)])));
    });
    const at = cursor === null ? null : x(end - cursor);
    this.line.setAttribute("d", at === null || at < this.left ? "" : `M${at.toFixed(1)},4V${bottom}`);
  }
}

function nearest(rows, t) {
  let best = null;
  for (const row of rows) if (best === null || Math.abs(row[0] - t) < Math.abs(best[0] - t)) best = row;
  return best;
}

// ---------------------------------------------------------------- the parts of the page

function keyOf(parent, index, name) {
  const key = element(parent, "span", `key ${dashed(index)}`);
  key.style.background = colour(index);
  parent.append(name);
}

// A part's heading, with a link to it in the page's head: on a phone the last part is ten screens below.
function heading(parent, text) {
  const title = element(parent, "h2", "", text), link = element(document.getElementById("parts"), "a", "", text);
  link.href = "#";  // what follows it names the vehicle
  link.addEventListener("click", (event) => {
    event.preventDefault();
    title.scrollIntoView();
  });
}

function stateCounts(state) {
  const counts = Object.fromEntries(Object.keys(STATES).map((word) => [word, 0]));
  for (const word of state.states ?? []) counts[word] += 1;
  return counts;
}

function buildHealth(main, names) {
  const tiles = element(main, "div", "tiles");
  names.forEach((name, index) => {
    const tile = element(tiles, "div", "tile");
    tile.style.borderLeftColor = colour(index);
    const title = element(tile, "h3");
    keyOf(element(title, "span"), index, shortName(name));
    const vehicle = element(title, "span", "soft");
    const health = element(title, "span");
    const bar = element(tile, "div", "bar");
    const parts = Object.entries(STATES).map(([word, [, level]]) => {
      const part = element(bar, "i");
      part.style.background = `var(--${COLOURS[level]})`;
      return [word, part];
    });
    const counts = element(tile, "p", "words");
    const inputs = element(tile, "p", "words soft");
    const note = element(main, "div", "note");
    updates.push(() => {
      const state = estimators.get(name);
      const of = state.statuses;
      vehicle.textContent = state.vehicle ?? "";
      const worst = Math.max(0, ...["inputs", "estimation"].map((kind) => of[kind]?.level ?? 0));
      health.className = `levels-${state.gone ? 3 : worst}`;
      health.textContent = state.gone
        ? (state.silent === null ? "has not spoken yet" : `silent for ${duration(state.silent)}`)
        : HEALTH[worst];
      const tally = stateCounts(state);
      parts.forEach(([word, part]) => {
        part.style.flexGrow = tally[word];
        part.hidden = !tally[word];
        part.title = `${tally[word]} ${word}`;
      });
      counts.textContent = Object.entries(tally).filter(([, n]) => n)
        .map(([word, n]) => `${STATES[word][0]} ${n} ${word}`).join(" · ");
      const rates = Object.entries(of.inputs?.values ?? {}).filter(([key]) => key.endsWith(" rate"))
        .map(([key, value]) => `${key.slice(0, -5)} ${value}`).join(", ");
      inputs.textContent = [rates, of.inputs?.message].filter(Boolean).join(" · ");
      const model = of.model;
      note.hidden = !(model && model.level > 0);
      if (!note.hidden) {
        const [score, penalty, share] = ["score", "penalty", "share"].map((key) => model.values[key]);
        const rivals = model.values.alternatives;
        note.replaceChildren();
        element(note, "strong", "", `${shortName(name)}: ${model.message}`);
        element(note, "p", "soft", `score ${score} (chance reaches ${penalty}), ` +
          `${(100 * share).toFixed(0)} % of the error` +
          (rivals ? `; or: ${rivals.split(" ").join(", ")}` : "") +
          ". A hint: `rov-ident explain` on a recording is the proof.");
      }
    });
  });
}

function buildBridges(main) {
  const list = element(main, "div");
  updates.push(() => {
    list.replaceChildren();
    for (const [name, status] of Object.entries(bridges)) {
      if (namespaceOf(name) !== chosen) continue;
      const note = element(list, "div", status.level ? "note" : "note calm");
      element(note, "strong", "", `${name} to ${status.values.controller}`);
      element(note, "p", "", status.message);
      if (status.values.pending) element(note, "p", "soft", `pending: ${status.values.pending}`);
    }
  });
}

function buildCoefficients(main, names, coefficients) {
  const top = element(main, "div", "heading");
  heading(top, "Coefficients");
  const choice = element(top, "div", "choice");
  for (const [seconds, label] of [[0, "whole run"], [60, "last minute"], [10, "last 10 s"]]) {
    const button = element(choice, "button", "", label);
    button.addEventListener("click", () => { recent = seconds; refresh(); });
    updates.push(() => button.setAttribute("aria-pressed", recent === seconds));
  }
  const legend = element(main, "div", "legend soft");
  names.forEach((name, index) => keyOf(element(legend, "span"), index, `${shortName(name)}, with its 95 % interval`));
  for (const [word, [sign, level]] of Object.entries(STATES))
    element(legend, "span", `levels-${level}`, `${sign} ${word}`);
  const grid = element(main, "div", "grid");
  for (const coefficient of coefficients) {
    const card = element(grid, "div", "card");
    card.dataset.coefficient = coefficient;
    const title = element(card, "h3", "", `${coefficient} `);
    const unit = element(title, "span", "soft");
    const picture = new Picture(card, names, `${coefficient} over time`, 118);
    const rows = names.map((_, index) => {
      const row = element(card, "div", "row");
      keyOf(element(row, "span"), index, "");
      const cells = { row, value: element(row, "span"), state: element(row, "span", "state") };
      cells.state.setAttribute("role", "img");  // a sign, whose word is read aloud
      return cells;
    });
    updates.push((start, end) => {
      let low = Infinity, high = -Infinity;
      const curves = names.map((name, index) => {
        const state = estimators.get(name), i = state.names.indexOf(coefficient);
        const { row, value, state: words } = rows[index];
        row.hidden = i < 0;
        if (i < 0) return [];
        unit.textContent = state.units[i];
        const at = cursor === null ? null : nearest(state.history, end - cursor);
        const [v, s] = at ? [at[1][i], at[2][i]] : [state.values[i], state.std[i]];
        value.textContent = `${written(v, s)} ± ${interval(s)}`;
        const word = state.states[i], [sign, level] = STATES[word];
        words.className = `state levels-${level}`;
        words.textContent = at ? `${duration(end - at[0])} ago` : sign;
        words.setAttribute("aria-label", at ? words.textContent : word);
        words.title = state.messages[i];
        const points = state.history.filter(([t]) => t >= start).map(([t, values, std]) =>
          [t, values[i], values[i] - 1.96 * std[i], values[i] + 1.96 * std[i]]);
        for (const [, value_] of points) { low = Math.min(low, value_); high = Math.max(high, value_); }
        for (const side of [-1, 1]) {  // a wide first interval may be cut, the last is seen whole
          low = Math.min(low, state.values[i] + side * 2.5 * state.std[i]);
          high = Math.max(high, state.values[i] + side * 2.5 * state.std[i]);
        }
        return points;
      });
      const pad = 0.06 * (high - low);
      picture.draw(curves, start, end, low - pad, high + pad);
    });
  }
}

// What the residual of one axis says in words, from [least, most, rms] of every half second. Noise has both signs in
// nearly every bin, and of two halves of it neither is twice as large.
function meaning(bins, what) {
  if (bins.length <= RECENT_BINS) return "";
  const recent = bins.slice(-RECENT_BINS);
  for (const [side, beyond] of [["above", ([least]) => least > 0], ["below", ([, most]) => most < 0]])
    if (recent.filter(beyond).length > 0.5 * RECENT_BINS) return `${side} zero: a steady ${what} is missing`;
  const size = (some) => Math.sqrt(some.reduce((sum, [, , rms]) => sum + rms * rms, 0) / some.length);
  return size(recent) > 2 * size(bins.slice(0, -RECENT_BINS)) ? "larger than before" : "around zero";
}

function buildResiduals(main, names) {
  heading(main, "Residual of the wrench");
  element(main, "p", "soft", "The force that acts and that the model does not know: measured minus model, the last " +
    "two minutes. Band: the extremes of half a second; curve: its root mean square. A good model leaves a narrow band " +
    "around zero, the noise of the sensors. A band beside zero is a steady force that is missing (a current, weight, a " +
    "tether); one that widens when the vehicle moves is wrong damping, added mass or thrust.");
  const grid = element(main, "div", "grid six");
  AXES.forEach((axis, k) => {
    const card = element(grid, "div", "card");
    const title = element(card, "h3", "", `${axis} `);
    element(title, "span", "soft", k < 3 ? "N" : "N m");
    const picture = new Picture(card, names, `residual ${axis} over time`, 104);
    const rows = names.map((_, index) => {
      const row = element(card, "div", "row");
      keyOf(element(row, "span"), index, "");
      return { rms: element(row, "span"), words: element(row, "span", "state soft") };
    });
    updates.push(() => {
      let low = Infinity, high = -Infinity, start = Infinity, end = -Infinity;
      const curves = names.map((name, index) => {
        const bins = estimators.get(name).residuals;
        const { rms, words } = rows[index];
        rms.textContent = bins.length
          ? `rms ${Number(bins.at(-1)[3][k]).toPrecision(2)} ${k < 3 ? "N" : "N m"}` : "no samples yet";
        words.textContent = meaning(bins.map((bin) => [bin[1][k], bin[2][k], bin[3][k]]), k < 3 ? "force" : "moment");
        for (const [t, least, most] of bins) {
          low = Math.min(low, least[k]); high = Math.max(high, most[k]);
          start = Math.min(start, t); end = Math.max(end, t);
        }
        return bins.map(([t, least, most, rms]) => [t, rms[k], least[k], most[k]]);
      });
      if (low <= high) picture.draw(curves, start, end, Math.min(low, 0), Math.max(high, 0));
    });
  });
}

function buildExcitation(main, names, coefficients) {
  heading(main, "Excitation");
  element(main, "p", "soft", "How much of what was not known beforehand the motion of the last 20 to 40 s " +
    `would tell by itself; below ${100 * EXCITED} % (the line) a coefficient is held.`);
  const bars = element(main, "div", "bars");
  for (const coefficient of coefficients) {
    const line = element(bars, "div", "line");
    element(line, "span", "name", coefficient).title = coefficient;
    const tracks = element(line, "div", "tracks");
    const fills = names.map((_, index) => {
      const fill = element(element(tracks, "div", "track"), "i");
      fill.style.background = colour(index);
      return fill;
    });
    element(tracks, "div", "sill");
    const number = element(line, "span", "number");
    updates.push(() => {
      const shares = names.map((name) => {
        const state = estimators.get(name), i = state.names.indexOf(coefficient);
        return i < 0 ? null : state.excitation[i];
      });
      shares.forEach((share, index) => { fills[index].style.transform = `scaleX(${share ?? 0})`; });
      const known = shares.filter((share) => share !== null);
      number.textContent = known.length ? `${(100 * Math.max(...known)).toFixed(0)} %` : "–";
    });
  }
}

function buildCorrelations(main, names) {
  heading(main, "What is not told apart");
  element(main, "p", "soft", "Correlation of the estimates: near −1 or 1 the data know a sum of two " +
    "coefficients better than either.");
  const maps = element(main, "div", "maps");
  names.forEach((name, index) => {
    const card = element(maps, "div", "map");
    keyOf(element(card, "h3"), index, shortName(name));
    const worst = element(card, "p", "soft");
    const frame = element(card, "div", "scroll");
    const svg = drawing(frame, "svg", { role: "img", "aria-label": `correlations of ${shortName(name)}` });
    let drawn = "";
    updates.push(() => {
      const { correlation, names: of } = estimators.get(name);
      card.hidden = !correlation || correlation.length !== of.length;
      const available = frame.clientWidth || 340;
      const state = JSON.stringify(correlation) + available;
      if (card.hidden || state === drawn) return;
      drawn = state;
      const n = of.length, room = 14 + 6 * Math.max(...of.map((text) => text.length));
      const cell = Math.max(CELL, Math.min(22, (available - room) / n)), size = cell * n;
      const width = Math.max(available, room + size);
      svg.replaceChildren();
      svg.setAttribute("viewBox", `0 0 ${width} ${size + room}`);
      svg.setAttribute("height", size + room);
      svg.setAttribute("width", width);
      let most = 0, pair = "";
      of.forEach((row, i) => {
        const y = room + (i + 0.5) * cell + 4;
        drawing(svg, "text", { x: room - 4, y, "text-anchor": "end" }).textContent = row;
        const x = room + (i + 0.5) * cell + 4;
        drawing(svg, "text", { transform: `translate(${x},${room - 4}) rotate(-90)` }).textContent = row;
        for (let j = 0; j < n; j++) {
          const value = correlation[i][j];
          const square = drawing(svg, "rect", {
            x: room + j * cell, y: room + i * cell, width: cell - 1, height: cell - 1,
            fill: i === j ? "var(--line)" : value < 0 ? "var(--low)" : "var(--high)",
            "fill-opacity": i === j ? 1 : Math.abs(value).toFixed(2),
          });
          drawing(square, "title", {}).textContent = `${row}, ${of[j]}: ${signed(value.toFixed(2))}`;
          if (j < i && Math.abs(value) > Math.abs(most)) { most = value; pair = `${of[j]} and ${row}`; }
        }
      });
      worst.textContent = pair && `strongest: ${pair}, ${signed(most.toFixed(2))}`;
    });
  });
}

function buildDetails(main, names) {
  for (const name of names) {
    const details = element(main, "details");
    element(details, "summary", "", `All that ${name} says of itself`);
    const table = element(element(details, "div", "scroll"), "table");
    updates.push(() => {
      if (!details.open) return;
      table.replaceChildren();
      const row = (...cells) => {
        const line = element(table, "tr");
        cells.forEach((cell) => element(line, "td", "", cell));
      };
      const state = estimators.get(name);
      for (const [kind, status] of Object.entries(state.statuses)) {
        row(kind, HEALTH[status.level], status.message);
        for (const [key, value] of Object.entries(status.values)) row("", key, value);
      }
      state.names.forEach((coefficient, i) => row(coefficient,
        `${written(state.values[i], state.std[i])} ± ${interval(state.std[i])} ${state.units[i]}`,
        state.messages[i]));
    });
  }
}

// ---------------------------------------------------------------- bringing it together

function refresh() {
  const namespaces = [...new Set([...estimators.keys()].map(namespaceOf))].sort();
  if (!namespaces.includes(chosen)) {
    const wanted = decodeURIComponent(location.hash.slice(1));
    chosen = namespaces.includes(wanted) ? wanted : namespaces[0] ?? null;
  }
  const names = [...estimators.keys()].filter((name) => namespaceOf(name) === chosen).sort();
  const coefficients = [...new Set(names.flatMap((name) => estimators.get(name).names))];
  const wanted = JSON.stringify([namespaces, names, coefficients]);
  if (wanted !== built) {
    built = wanted;
    build(namespaces, names, coefficients);
  }
  let start = Infinity, end = -Infinity;
  for (const name of names) {
    const { history } = estimators.get(name);
    if (!history.length) continue;
    start = Math.min(start, history[0][0]);
    end = Math.max(end, history.at(-1)[0]);
  }
  if (recent) start = Math.max(start, end - recent);
  for (const update of updates) update(start, end);
}

function build(namespaces, names, coefficients) {
  updates = [];
  widths.disconnect();
  const nav = document.getElementById("vehicles"), main = document.getElementById("main");
  nav.replaceChildren();
  document.getElementById("parts").replaceChildren();
  main.replaceChildren();
  if (namespaces.length > 1) for (const namespace of namespaces) {
    const button = element(nav, "button", "", namespace === "/" ? "no namespace" : namespace);
    button.setAttribute("aria-pressed", namespace === chosen);
    button.addEventListener("click", () => {
      chosen = namespace;
      location.hash = encodeURIComponent(namespace);
      built = "";
      refresh();
      nav.querySelector("[aria-pressed=true]").focus();  // the button pressed is another element now
    });
  }
  if (!names.length) {
    element(main, "p", "empty", "No estimator is heard yet. Start rls_node or ukf_node, with the " +
      "ROS_DOMAIN_ID that this dashboard was started with.");
    return;
  }
  buildHealth(main, names);
  buildBridges(main);
  if (!coefficients.length) {
    element(main, "p", "empty", "The nodes are there, and have not reported yet.");
    return;
  }
  buildCoefficients(main, names, coefficients);
  buildResiduals(main, names);
  buildExcitation(main, names, coefficients);
  buildCorrelations(main, names);
  buildDetails(main, names);
}

function take(message) {
  bridges = message.bridges;
  for (const [name, state] of Object.entries(message.estimators)) {
    const before = estimators.get(name);
    for (const series of ["history", "residuals"]) {
      const { anew, rows } = state[series];
      state[series] = anew || !before ? rows : before[series].concat(rows);
    }
    state.residuals = state.residuals.slice(-BINS);
    estimators.set(name, state);
  }
  refresh();
}

function connect() {
  const status = document.getElementById("connection");
  const socket = new WebSocket(`ws://${location.host}/live`);
  let heard = 0;
  socket.addEventListener("message", (event) => {
    heard += 1;
    status.textContent = "live";
    status.className = "";
    take(JSON.parse(event.data));
    document.documentElement.dataset.messages = heard;
  });
  socket.addEventListener("close", () => {
    status.textContent = "connection lost: is the dashboard still running?";
    status.className = "lost";
    setTimeout(connect, 2000);
  });
}

connect();
