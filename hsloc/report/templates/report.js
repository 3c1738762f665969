"use strict";
(async () => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const image = data.map ? new Image() : null;
  if (image) { image.src = data.map.image; await image.decode(); }
  new globalThis.ResultView(document.getElementById("view"), data, image, document.getElementById("charts"));
})();
