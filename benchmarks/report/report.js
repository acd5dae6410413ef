"use strict";

// A click on a header sorts its table up, then down, then as written. Blanks stay at the end.
const NEXT = { none: "ascending", ascending: "descending", descending: "none" };
const ORDER = new Intl.Collator("en", { numeric: true });

function compare(a, b, isNumber, sign) {
  const key = (cell) => (isNumber ? cell.dataset.value : cell.textContent.trim()) || "";
  const [p, q] = [key(a), key(b)];
  if (!p || !q) return Number(!p) - Number(!q);
  return sign * (isNumber ? Math.sign(Number(p) - Number(q)) || 0 : ORDER.compare(p, q));
}

for (const table of document.querySelectorAll("table.sortable")) {
  const body = table.tBodies[0];
  const written = [...body.rows];
  const heads = [...table.tHead.rows[0].cells];
  heads.forEach((head, column) => {
    head.querySelector("button").addEventListener("click", () => {
      const next = NEXT[head.getAttribute("aria-sort")];
      for (const other of heads) other.setAttribute("aria-sort", other === head ? next : "none");
      const isNumber = head.classList.contains("number");
      const sign = next === "descending" ? -1 : 1;
      const rows = [...written];
      if (next !== "none") {
        rows.sort((a, b) => compare(a.cells[column], b.cells[column], isNumber, sign));
      }
      body.append(...rows);
    });
  });
}

// What is packed: gzip in base64, numbers as steps in whole quanta.
async function unpack(script) {
  const bytes = Uint8Array.from(atob(script.textContent), (letter) => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).text();
}

function numbers(values) {
  if (!values?.steps) return values;
  let at = 0;
  return values.steps.map((step) => (step === null ? null : values.from + values.by * (at += step)));
}

// Figures take the page's colours, light or dark; black, the colour of facts, becomes its ink.
const DARK = window.matchMedia("(prefers-color-scheme: dark)");
const TOUCH = window.matchMedia("(hover: none)");
const NARROW = window.matchMedia("(max-width: 40rem)");
const CONFIG = {
  responsive: true,
  displaylogo: false,
  showSendToCloud: false, // on by default: it would upload the figure
  plotlyServerURL: "",
  displayModeBar: TOUCH.matches ? false : "hover",
  modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d"],
  toImageButtonOptions: { format: "svg", filename: "sideslip" },
};

function shade(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}

function template() {
  const axis = {
    gridcolor: shade("--grid"), linecolor: shade("--rule"), zerolinecolor: shade("--rule"),
    tickcolor: shade("--rule"), ticks: "outside", showline: true, zeroline: false,
    title: { standoff: 12, font: { size: 13 } },
  };
  const family = getComputedStyle(document.body).fontFamily;
  return {
    layout: {
      font: { family, size: 12, color: shade("--text") },
      paper_bgcolor: shade("--page"), plot_bgcolor: shade("--page"),
      hoverlabel: { bgcolor: shade("--raised"), bordercolor: shade("--rule"), font: { family } },
      modebar: {
        orientation: "v", bgcolor: "rgba(0,0,0,0)",
        color: shade("--quiet"), activecolor: shade("--link"),
      },
      xaxis: axis, yaxis: axis, margin: { l: 12, r: 12, t: 12, b: 12 },
    },
  };
}

function inked(colour) {
  if (Array.isArray(colour)) return colour.map(inked);
  return colour === "#000000" ? shade("--ink") : colour;
}

function broken(text) {
  const lines = Math.ceil(text.length / 28);
  const length = lines > 1 ? Math.ceil(text.length / lines) + 4 : text.length;
  return text.replace(new RegExp(`(.{1,${length}})(?:\\s+|$)`, "g"), "$1<br>").slice(0, -4);
}

const DRAWN = new Map(); // figure to the text of its data

function draw(figure) {
  const { data, layout = {} } = JSON.parse(DRAWN.get(figure));
  for (const trace of data) {
    for (const axis of ["x", "y"]) trace[axis] = numbers(trace[axis]);
    for (const pen of [trace.line, trace.marker, trace.marker?.line, trace.error_x]) {
      if (pen?.color) pen.color = inked(pen.color);
    }
  }
  for (const shape of layout.shapes ?? []) {
    if (shape.line?.color) shape.line.color = inked(shape.line.color);
  }
  if (NARROW.matches) {
    // The legend becomes a column above the plot, long titles of axes become several lines.
    if (layout.showlegend && layout.height) layout.height += 16 * data.length;
    if (!layout.showlegend) {
      for (const axis of [layout.xaxis, layout.yaxis]) if (axis) axis.tickfont = { size: 10 };
      for (const title of layout.annotations ?? []) title.font = { ...title.font, size: 10 };
    }
    for (const title of [layout.xaxis?.title, layout.yaxis?.title]) {
      if (title?.text) title.text = broken(title.text);
    }
  }
  // A finger shall scroll the page, not zoom the figure it lands on.
  const dragmode = TOUCH.matches ? false : "zoom";
  const themed = { dragmode, ...layout, template: template() };
  Plotly.react(figure.querySelector(".plot"), data, themed, CONFIG);
}

function drawAll() {
  for (const figure of DRAWN.keys()) draw(figure);
}

// One figure a turn, so that the page can be read and scrolled from the start; what is folded
// when it is opened. A figure that fails stops no other.
async function drawInTurn(figures) {
  for (const figure of figures) {
    if (DRAWN.has(figure)) continue;
    const text = await unpack(figure.querySelector("script"));
    DRAWN.set(figure, text);
    await new Promise((resolve) => setTimeout(resolve));
    try {
      draw(figure);
    } catch (error) {
      console.error(error);
    }
  }
}

function figuresIn(place, folded = "details:not([open]) figure") {
  const hidden = new Set(place.querySelectorAll(folded));
  return [...place.querySelectorAll("figure:not(.explorer)")].filter((each) => !hidden.has(each));
}

async function drawEverything() {
  const packed = document.querySelector("script[data-name=plotly]");
  if (!packed) return;
  if (!window.DecompressionStream) {
    document.getElementById("unable").hidden = false;
    return;
  }
  const library = document.createElement("script");
  library.textContent = await unpack(packed);
  document.head.append(library);
  await drawInTurn(figuresIn(document));
  for (const figure of document.querySelectorAll("figure.explorer")) await explore(figure);
  for (const folded of document.querySelectorAll("details")) {
    folded.addEventListener("toggle", () => folded.open && drawInTurn(figuresIn(folded)));
    if (folded.open) drawInTurn(figuresIn(folded)); // opened meanwhile
  }
  document.body.dataset.drawn = "all";
}

function setPrinting(printing) {
  document.documentElement.classList.toggle("printing", printing);
  if (DARK.matches) drawAll();
}

setTimeout(drawEverything);
DARK.addEventListener("change", drawAll);
NARROW.addEventListener("change", drawAll);
window.addEventListener("beforeprint", () => setPrinting(true));
window.addEventListener("afterprint", () => setPrinting(false));
