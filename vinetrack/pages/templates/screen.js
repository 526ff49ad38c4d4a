// A swipe over a figure scrolls the page, as it does elsewhere.
for (const plot of [...plots, film]) Bokeh.index.find_one(plot)?.canvas_view?.events_el?.style.setProperty("touch-action", "pan-y");

// Bokeh gives sliders and tick boxes no name that a screen reader finds.
for (const model of film.document.all_models) {
  const inside = Bokeh.index.find_one(model)?.shadow_el?.querySelector(".noUi-handle, input[type=checkbox]");
  inside?.setAttribute("aria-label", model.title ?? model.label);
}
