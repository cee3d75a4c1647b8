// Gives each slider of Bokeh the name and the value that a screen reader says.
(function speak(times) {
  let missing = 0;
  for (const document of Bokeh.documents) {
    for (const model of document.all_models) {
      if (model.type !== "Slider" || model.tags.includes("spoken")) continue;
      const root = Bokeh.index.find_one(model)?.shadow_el;
      const handle = root?.querySelector(".noUi-handle");
      if (!handle) { missing += 1; continue; }
      const say = () => handle.setAttribute(
        "aria-valuetext", root.querySelector(".noUi-tooltip").textContent);
      handle.setAttribute("aria-label", model.title);
      model.properties.value.change.connect(say);
      model.tags.push("spoken");
      say();
    }
  }
  if ((missing || !Bokeh.documents.length) && times) setTimeout(speak, 200, times - 1);
})(50);
