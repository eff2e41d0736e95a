// The picture that one sends: the view, what its colours mean, and the strips below it.

function screenshot() {
  if (!state.scan) return;
  const link = made("a");
  pictureNow().toBlob((blob) => {
    link.href = URL.createObjectURL(blob);
    link.download = `${source.name(state.number).replace(/[^\w.-]+/g, "_")}_${state.word}.png`;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10000);
  }, "image/png");
}

function pictureNow() {
  motion.paint(1); // and read before the browser clears it
  const view = $("scene"), scale = view.width / view.clientWidth;
  const strips = $("strips").hidden ? [] : [...$("strips").querySelectorAll("canvas")];
  const canvas = made("canvas"), context = canvas.getContext("2d"), tall = 72 * scale, gap = 6 * scale;
  canvas.width = view.width;
  canvas.height = view.height + strips.length * (tall + gap);
  context.fillStyle = "#0b0d11";
  context.fillRect(0, 0, canvas.width, canvas.height);
  context.drawImage(view, 0, 0);
  strips.forEach((strip, k) => context.drawImage(strip, 0, view.height + gap + k * (tall + gap), canvas.width, tall));
  context.scale(scale, scale);
  writeDistances(context);
  writeCaption(context);
  return canvas;
}

function writeDistances(context) {
  Object.assign(context, { font: "11px system-ui, sans-serif", textBaseline: "middle", fillStyle: "#8390a8" });
  for (const label of $("distances").children) {
    const { e: x, f: y } = new DOMMatrix(label.style.transform);
    if (!label.hidden) context.fillText(label.textContent, x - 12, y);
  }
}

function writeCaption(context) {
  const caption = source.captions(state.number)[state.version], legend = $("legend");
  context.font = "13px system-ui, sans-serif";
  context.textBaseline = "top";
  const lines = [source.name(state.number) + (source.captions(state.number).length > 1 ? `, ${caption}` : ""), $("facts").textContent];
  lines.forEach((line, k) => { context.fillStyle = k ? "#8d97a6" : "#dfe4ea"; context.fillText(line, 16, 14 + 20 * k); });
  context.fillText($("unit").textContent, 16, 62);
  if (legend.querySelector("canvas")) {
    context.drawImage(legend.querySelector("canvas"), 16, 82, 240, 10);
    for (const label of legend.querySelectorAll(".ticks span")) {
      const share = parseFloat(label.style.left) / 100;
      context.textAlign = share < 0.03 ? "left" : share > 0.97 ? "right" : "center";
      context.fillText(label.textContent, 16 + 240 * share, 96);
    }
    context.textAlign = "left";
  } else if (legend.querySelector(".note")) { // a scan without that field
    context.fillText(legend.textContent, 16, 82);
  } else {
    [...legend.querySelectorAll(".class[aria-pressed=true]")].forEach((row, k) => {
      context.fillStyle = row.querySelector("i").style.background;
      context.fillRect(16, 84 + 19 * k, 10, 10);
      context.fillStyle = "#8d97a6";
      context.fillText([...row.querySelectorAll("span, b")].map((part) => part.textContent).join("  "), 34, 82 + 19 * k);
    });
  }
}
