// Gives each slider of Bokeh the name and the value that a screen reader says.
(function speak(times) {
  let missing = 0;
  for (const document of Bokeh.documents) {
    for (const model of document.all_models) {
      if (model.type !== "Slider" || model.tags.includes("spoken")) continue;
      const root = Bokeh.index.find_one(model)?.shadow_el;
      const handle = root?.querySelector(".noUi-handle");
      if (!handle) { missing += 1; continue; }
      const say = () => {
        const told = root.querySelector(".noUi-tooltip").textContent;
        if (handle.getAttribute("aria-valuetext") !== told) {
          handle.setAttribute("aria-valuetext", told);
        }
      };
      handle.setAttribute("aria-label", model.title);
      // The slider writes a number of its own there each time that it moves.
      new MutationObserver(say).observe(handle, { attributeFilter: ["aria-valuetext"] });
      model.tags.push("spoken");
      say();
    }
  }
  if ((missing || !Bokeh.documents.length) && times) setTimeout(speak, 200, times - 1);
})(50);
