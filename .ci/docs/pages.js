// What scrolls can be reached by the keyboard, and headings of the contents have their level.
addEventListener("DOMContentLoaded", () => {
  const reach = () => document.querySelectorAll("pre, .table-wrapper, div.math").forEach((one) => {
    if (one.scrollWidth > one.clientWidth) one.tabIndex = 0;
  });
  reach();
  addEventListener("resize", reach);
  document.querySelectorAll("[role=heading]:not([aria-level])").forEach((one) => {
    one.setAttribute("aria-level", "2");
  });
});
