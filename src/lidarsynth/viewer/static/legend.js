// What colours mean: a ramp with ticks and its unit, or the classes that the scan has with their shares of the points.

function paintLegend(element, scan, word, by) {
  const focus = [...element.children].findIndex((row) => row === document.activeElement);
  element.replaceChildren();
  if (!canColour(scan, by)) return element.append(made("p", "note", `this scan has no ${by.fields.join(" and ").replace("new", "field new")}`));
  element.append(...(by.classes ? classRows(scan, word, by) : ramp(by)));
  if (focus >= 0 && by.classes) element.children[focus]?.focus(); // who toggles by the keyboard stays there
}

function ramp(by) {
  const canvas = made("canvas", "ramp");
  canvas.width = 256;
  canvas.height = 1;
  const context = canvas.getContext("2d"), image = context.createImageData(256, 1);
  for (let i = 0; i < 256; i++) image.data.set([...by.shades.subarray(3 * i, 3 * i + 3), 255], 4 * i);
  context.putImageData(image, 0, 0);
  const ticks = made("div", "ticks");
  for (const tick of by.ticks) {
    const place = placeOn(by, tick), label = made("span", "", String(tick));
    if (place < -0.001 || place > 1.001) continue;
    label.style.left = `${100 * place}%`;
    label.style.transform = `translateX(${place < 0.03 ? 0 : place > 0.97 ? -100 : -50}%)`;
    ticks.append(label);
  }
  return [canvas, ticks];
}

function classRows(scan, word, by) {
  const counts = new Array(by.classes.length).fill(0);
  for (const value of scan.fields[word]) counts[value]++;
  const order = counts.map((count, k) => k).filter((k) => counts[k]).sort((a, b) => counts[b] - counts[a]);
  return order.map((k) => {
    const row = made("button", "class"), swatch = made("i", "swatch"), share = (100 * counts[k]) / scan.n;
    row.title = "hide or show; with Shift, show it alone";
    row.setAttribute("aria-pressed", String(!state.hidden[word]?.has(k)));
    row.onclick = (event) => toggleClass(word, k, event.shiftKey);
    swatch.style.background = `rgb(${by.classes[k][1].join(",")})`;
    row.append(swatch, made("span", "", by.classes[k][0]), made("b", "", share < 0.1 ? "< 0.1 %" : `${share.toFixed(1)} %`));
    return row;
  });
}

function made(kind, name, text = "") {
  const element = document.createElement(kind);
  if (name) element.className = name;
  if (text) element.textContent = text;
  return element;
}
