// A figure with menus: any cell's time series. The last choice stays where the next one has it.
const EXPLORERS = [];
function explore(figure) {
  const { menus, panels, cells } = JSON.parse(figure.querySelector("script").textContent);
  const plot = figure.querySelector(".plot");
  const selects = menus.map((name) => {
    const label = document.createElement("label");
    const select = document.createElement("select");
    select.setAttribute("aria-label", name);
    label.append(`${name} `, select);
    figure.querySelector(".menus").append(label);
    return select;
  });

  function choices(level) {
    const chosen = selects.slice(0, level).map((select) => select.value);
    const fitting = cells.filter(([key]) => chosen.every((name, i) => key[i] === name));
    return [...new Set(fitting.map(([key]) => key[level]))];
  }

  function fill(from) {
    for (let level = from; level < selects.length; level++) {
      const before = selects[level].value;
      const names = choices(level);
      selects[level].replaceChildren(...names.map((name) => new Option(name || "(none)", name)));
      if (names.includes(before)) selects[level].value = before;
    }
  }

  function show() {
    const chosen = selects.map((select) => select.value);
    const [, signals] = cells.find(([key]) => key.every((name, i) => name === chosen[i]));
    const data = panels.flatMap(({ lines }, row) =>
      lines.map(([signal, name, colour]) => ({
        x: signals.t, y: signals[signal], name, type: "scatter", mode: "lines",
        line: { color: inked(colour), width: 1.8, dash: name === "reference" ? "dash" : "solid" },
        xaxis: "x", yaxis: row ? `y${row + 1}` : "y", legendgroup: name,
        showlegend: panels.findIndex((p) => p.lines.some((l) => l[1] === name)) === row,
      })),
    );
    const layout = {
      height: 190 * panels.length + 60, hovermode: "x unified", showlegend: true,
      legend: { orientation: "h", x: 0, y: 1.02, yanchor: "bottom" },
      xaxis: { title: { text: "time / s" }, anchor: `y${panels.length > 1 ? panels.length : ""}` },
      dragmode: TOUCH.matches ? false : "zoom", template: template(),
    };
    panels.forEach(({ label }, row) => {
      const top = 1 - row / panels.length;
      layout[row ? `yaxis${row + 1}` : "yaxis"] = {
        title: { text: label }, domain: [top - 0.88 / panels.length, top],
        automargin: true, hoverformat: ".4~g",
      };
    });
    Plotly.react(plot, data, layout, CONFIG);
  }

  selects.forEach((select, level) => select.addEventListener("change", () => {
    fill(level + 1);
    show();
  }));
  fill(0);
  show();
  EXPLORERS.push(show);
}

for (const figure of document.querySelectorAll("figure.explorer")) setTimeout(explore, 0, figure);
DARK.addEventListener("change", () => EXPLORERS.forEach((show) => show()));
for (const name of ["beforeprint", "afterprint"]) { // after the page has changed its colours
  window.addEventListener(name, () => DARK.matches && EXPLORERS.forEach((show) => show()));
}
