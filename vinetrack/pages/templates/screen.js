// Figures are drawn on a canvas, which no style sheet reaches: every colour that the page has a property for is set to
// what the property is now, and again whenever the screen turns light or dark. The server need not know.
const first = new Map();
const asked = matchMedia("(prefers-color-scheme: dark)");

function shaded(colour, style) {
  const token = tokens[colour.toLowerCase()];
  return token === undefined ? colour : style.getPropertyValue(token).trim();
}

function colours_of(value) {
  if (typeof value === "string") return [value];
  if (Array.isArray(value)) return value.filter((one) => typeof one === "string");
  return typeof value?.value === "string" ? [value.value] : [];
}

function paint() {
  const style = getComputedStyle(document.documentElement);
  for (const plot of plots) {
    for (const model of plot.references()) {
      for (const {attr, is_unset} of model) {
        if (is_unset || !/(_color|^palette)$/.test(attr)) continue;
        const key = `${model.id} ${attr}`;
        if (!first.has(key)) first.set(key, colours_of(model[attr]));
        const now = first.get(key).map((colour) => shaded(colour, style));
        if (now.length === 0 || String(now) === String(colours_of(model[attr]))) continue;
        model.setv({[attr]: attr === "palette" ? now : now[0]}, {sync: false});
      }
    }
  }
}

// A recording keeps its greys, and the edges their colours over them.
paint();
asked.addEventListener("change", paint);

// A swipe over a figure scrolls the page, as it does elsewhere.
for (const plot of [...plots, film]) Bokeh.index.find_one(plot)?.canvas_view?.events_el?.style.setProperty("touch-action", "pan-y");

// Bokeh gives sliders and tick boxes no name that a screen reader finds.
for (const model of film.document.all_models) {
  const inside = Bokeh.index.find_one(model)?.shadow_el?.querySelector(".noUi-handle, input[type=checkbox]");
  inside?.setAttribute("aria-label", model.title ?? model.label);
}
