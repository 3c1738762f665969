"use strict";
(async () => {
  const { runs, seeds } = JSON.parse(document.getElementById("data").textContent), map = runs[0].data.map;
  if (map) { runs[0].image = new Image(); runs[0].image.src = map.image; await runs[0].image.decode(); }
  new globalThis.ResultComparison(document.getElementById("comparison"), runs, seeds);
})();
