(() => {
  "use strict";
  const flight = document.querySelector("video.flight");
  if (flight && !matchMedia("(prefers-reduced-motion: reduce)").matches) {
    const seen = ([entry]) => (entry.isIntersecting ? flight.play().catch(() => {}) : flight.pause());
    new IntersectionObserver(seen, { threshold: 0.3 }).observe(flight);
  }
  const wipe = document.querySelector(".wipe");
  if (!wipe) return;
  const slider = wipe.querySelector("input");
  const before = wipe.querySelector(".before");
  const after = wipe.querySelector(".after");
  const tag = wipe.querySelector(".tag.two");
  const left = document.querySelector("#left");
  const one = wipe.querySelector(".tag.one");
  const shown = { style: 0, view: 0 };

  const move = (at) => {
    slider.value = Math.min(100, Math.max(0, at));
    wipe.style.setProperty("--at", `${slider.value}%`);
    slider.setAttribute("aria-valuetext", `${Math.round(slider.value)} % original`);
  };
  slider.addEventListener("input", () => move(Number(slider.value)));
  slider.addEventListener("keydown", (event) => {
    const way = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1 }[event.key];
    if (!way) return;
    event.preventDefault();
    move(Number(slider.value) + way * (event.shiftKey ? 10 : 2));
  });

  const follow = (event) => {
    const box = wipe.getBoundingClientRect();
    move((100 * (event.clientX - box.left)) / box.width);
  };
  wipe.addEventListener("pointerdown", (event) => {
    if (event.button) return;
    wipe.setPointerCapture(event.pointerId);
    follow(event);
    slider.focus({ preventScroll: true, focusVisible: false });
    event.preventDefault();
  });
  wipe.addEventListener("pointermove", (event) => {
    if (wipe.hasPointerCapture(event.pointerId)) follow(event);
  });

  const show = (change) => {
    Object.assign(shown, change);
    const original = document.querySelector(`[data-view="${shown.view}"] img`);
    const taken = document.querySelector(`[data-shot="${shown.style}-${shown.view}"] img`);
    const from = left.value === "match" ? `[data-match="${shown.style}-${shown.view}"] img` : `[data-shot="${left.value}-${shown.view}"] img`;
    const against = left.value === "original" ? original : document.querySelector(from) || original;
    before.src = against.src;
    before.alt = against.alt;
    after.src = taken.src;
    after.alt = taken.alt;
    one.textContent = against === original ? "Original" : left.selectedOptions[0].textContent;
    const { width, height } = original.dataset;
    wipe.style.setProperty("--ratio", String(width / height));
    wipe.style.setProperty("--most", `${Math.max(760, 2.6 * width)}px`);
    document.querySelectorAll("[data-style], [data-view]").forEach((button) => {
      const { style, view } = button.dataset;
      button.setAttribute("aria-pressed", String(style === String(shown.style) || view === String(shown.view)));
    });
    tag.textContent = document.querySelector(`[data-style="${shown.style}"]`).textContent.trim();
  };
  document.addEventListener("click", (event) => {
    const button = event.target.closest("button");
    if (!button) return;
    const { style, view, shot, go } = button.dataset;
    if (style) show({ style: Number(style) });
    if (view) show({ view: Number(view) });
    if (shot || go) {
      const [style, view] = (shot || go).split("-");
      show({ style: style === "" ? shown.style : Number(style), view: Number(view) });
      wipe.scrollIntoView({ block: "center" });
      slider.focus({ preventScroll: true });
    }
  });
  left.addEventListener("change", () => show({}));
  left.value = "original";
  move(50);
})();
