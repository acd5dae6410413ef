// Two cells side by side: over time, and in motion where the data has the car's place.
const EXPLORERS = [];
const WINDOW = 32; // m of the road that are seen
const ARROW = 0.25; // s of driving that the arrow of the velocity is long

function element(name, properties = {}, ...children) {
  const made = Object.assign(document.createElement(name), properties);
  made.append(...children);
  return made;
}

function menu(place, name) {
  const select = element("select");
  select.setAttribute("aria-label", name);
  place.append(element("label", {}, `${name} `, select));
  return select;
}

function fill(select, names, wanted = select.value) {
  select.replaceChildren(...names.map((name) => new Option(name || "(none)", name)));
  if (names.includes(wanted)) select.value = wanted;
}

async function explore(figure) {
  const content = JSON.parse(await unpack(figure.querySelector("script")));
  const shared = element("div", { className: "menus" });
  const selects = content.menus.map((name) => menu(shared, name));
  const sides = ["left", "right"].map((name) => {
    const box = element("div", { className: "side" });
    const who = menu(box, name);
    const road = element("canvas", { className: "road" });
    const plot = element("div", { className: "plot" });
    const cursor = element("div", { className: "cursor" });
    box.append(road, element("div", { className: "timed" }, plot, cursor));
    return { who, road, plot, cursor, box };
  });
  const clock = element("input", { type: "range", min: 0, max: 1, step: 0.001, value: 0.4 });
  clock.setAttribute("aria-label", "time");
  const button = element("button", { type: "button", textContent: "Play" });
  const reading = element("output");
  const player = element("div", { className: "player" }, button, clock, reading);
  const both = element("div", { className: "sides" }, ...sides.map((side) => side.box));
  figure.querySelector("script").before(shared, player, both);

  const chosen = () => selects.map((select) => select.value);
  const fits = (key, names) => names.every((name, i) => key[i] === name);

  function refill(from) {
    for (let level = from; level < selects.length; level++) {
      const before = chosen().slice(0, level);
      const there = content.cells.filter(([key]) => fits(key, before)).map(([key]) => key[level]);
      fill(selects[level], [...new Set(there)]);
    }
    const names = content.cells.filter(([key]) => fits(key, chosen())).map(([key]) => key.at(-1));
    sides.forEach(({ who }, i) => {
      const wanted = [who.value, content.pair[i], names[i]].find((name) => names.includes(name));
      fill(who, names, wanted);
    });
  }

  function choose() {
    for (const side of sides) {
      const key = [...chosen(), side.who.value];
      const [, packed] = content.cells.find(([each]) => fits(each, key));
      side.signals = Object.fromEntries(
        Object.entries(packed).map(([name, values]) => [name, numbers(values)]),
      );
      side.colour = inked(content.colours[side.who.value]);
      const body = content.bodies.find(([each]) => fits(each, chosen()));
      side.body = body ? body[1] : [2.5, 1.5];
      side.road.hidden = !side.signals.X;
    }
    player.hidden = sides.every((side) => side.road.hidden);
    show();
  }

  function reach(row) { // of both sides alike
    const seen = content.panels[row].lines.flatMap(([signal]) =>
      sides.flatMap((side) => side.signals[signal].filter((value) => value !== null)));
    const low = seen.reduce((a, b) => Math.min(a, b), 0);
    const high = seen.reduce((a, b) => Math.max(a, b), 0);
    const spare = 0.06 * (high - low) || 1;
    return [low - spare, high + spare];
  }

  const end = () => Math.max(...sides.map((side) => side.signals.t.at(-1)));

  function show() {
    const count = content.panels.length;
    for (const side of sides) {
      const data = content.panels.flatMap(({ lines }, row) =>
        lines.map(([signal, name], i) => ({
          x: side.signals.t, y: side.signals[signal], name, type: "scatter", mode: "lines",
          line: i ? { color: shade("--ink"), width: 1.4, dash: "dash" } : { color: side.colour, width: 2 },
          xaxis: "x", yaxis: row ? `y${row + 1}` : "y", showlegend: false,
        })));
      const layout = {
        height: 150 * count + 60, hovermode: "x unified", template: template(),
        xaxis: { title: { text: "time / s" }, anchor: `y${count > 1 ? count : ""}`, range: [0, end()] },
        dragmode: TOUCH.matches ? false : "zoom", margin: { l: 64, r: 8, t: 8, b: 44 },
      };
      content.panels.forEach(({ label }, row) => {
        const top = 1 - row / count;
        layout[row ? `yaxis${row + 1}` : "yaxis"] = {
          title: { text: label, font: { size: 11 } }, domain: [top - 0.86 / count, top],
          range: reach(row), hoverformat: ".4~g",
        };
      });
      Plotly.react(side.plot, data, layout, CONFIG);
    }
    move();
  }

  function move() {
    const t = Number(clock.value) * end();
    reading.textContent = `${t.toFixed(2)} s`;
    for (const side of sides) {
      const axis = side.plot._fullLayout.xaxis;
      side.cursor.style.left = `${axis._offset + axis.d2p(t)}px`;
      if (!side.road.hidden) road(side, t);
    }
  }

  let started = null;
  function play(now) {
    if (started === null) return;
    const t = (now - started) / 1000;
    clock.value = Math.min(t / end(), 1);
    move();
    if (t < end()) requestAnimationFrame(play);
    else pause();
  }
  function pause() {
    started = null;
    button.textContent = "Play";
  }
  button.addEventListener("click", () => {
    if (started !== null) return pause();
    const from = Number(clock.value) < 1 ? Number(clock.value) * end() : 0;
    started = performance.now() - 1000 * from;
    button.textContent = "Pause";
    requestAnimationFrame(play);
  });
  clock.addEventListener("input", () => {
    pause();
    move();
  });
  selects.forEach((select, level) => select.addEventListener("change", () => {
    refill(level + 1);
    choose();
  }));
  for (const { who } of sides) who.addEventListener("change", choose);
  refill(0);
  choose();
  EXPLORERS.push(choose);
}

// A value at a time between two samples; after the last it stays.
function between(t, times, values) {
  const after = times.findIndex((each) => each > t);
  if (after < 1) return values.at(after < 0 ? -1 : 0);
  const share = (t - times[after - 1]) / (times[after] - times[after - 1]);
  return values[after - 1] + share * (values[after] - values[after - 1]);
}

// The car from above: its body, where it goes (the arrow), where it has been.
function road({ road: canvas, signals, colour, body }, t) {
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  const sharp = window.devicePixelRatio || 1;
  canvas.width = width * sharp;
  canvas.height = height * sharp;
  const pen = canvas.getContext("2d");
  const at = (name, time = t) => between(time, signals.t, signals[name]);
  const [X, Y, psi] = [at("X"), at("Y"), at("psi")];
  const scale = (sharp * width) / WINDOW;
  pen.setTransform(scale, 0, 0, -scale, 0.4 * canvas.width, 0.5 * canvas.height);
  pen.lineWidth = 1 / scale;
  pen.strokeStyle = shade("--grid");
  for (let x = Math.ceil((X - 20) / 5) * 5; x < X + 20; x += 5) line(pen, [[x - X, -20], [x - X, 20]]);
  for (let y = Math.ceil((Y - 10) / 5) * 5; y < Y + 10; y += 5) line(pen, [[-20, y - Y], [20, y - Y]]);
  pen.strokeStyle = colour;
  pen.lineWidth = 0.12;
  const behind = signals.t.filter((each) => each <= t);
  line(pen, [...behind.map((_, i) => [signals.X[i] - X, signals.Y[i] - Y]), [0, 0]]);
  const last = Math.min(t, signals.t.at(-1));
  const go = ["X", "Y"].map((name) => (ARROW * (at(name, last) - at(name, last - 0.1))) / 0.1);
  pen.strokeStyle = shade("--ink");
  line(pen, [[0, 0], go]);
  pen.rotate(psi);
  pen.fillStyle = colour;
  pen.fillRect(-0.5 * body[0], -0.5 * body[1], ...body);
  pen.fillStyle = shade("--page"); // the windscreen
  pen.fillRect(0.12 * body[0], -0.38 * body[1], 0.12 * body[0], 0.76 * body[1]);
  pen.setTransform(sharp, 0, 0, sharp, 0, 0);
  pen.fillStyle = shade("--quiet");
  pen.font = `12px ${getComputedStyle(document.body).fontFamily}`;
  const slip = signals.beta ? `slip ${at("beta").toFixed(0)} mrad` : "";
  pen.fillText(t > signals.t.at(-1) ? `over at ${signals.t.at(-1).toFixed(2)} s` : slip, 8, 18);
  pen.fillText("a square: 5 m", 8, height - 8);
}

function line(pen, points) {
  pen.beginPath();
  points.forEach(([x, y], i) => (i ? pen.lineTo(x, y) : pen.moveTo(x, y)));
  pen.stroke();
}

DARK.addEventListener("change", () => EXPLORERS.forEach((choose) => choose()));
for (const name of ["beforeprint", "afterprint"]) { // after the page has changed its colours
  window.addEventListener(name, () => DARK.matches && EXPLORERS.forEach((choose) => choose()));
}
window.addEventListener("resize", () => EXPLORERS.forEach((choose) => choose()));
