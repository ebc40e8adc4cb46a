// The view that is seen as one file that needs nothing else: HTML, or a picture of all of it. Runs in the browser alone.
(() => {
  const styles = (rules) => [...rules].map((rule) => {
    if (rule instanceof CSSImportRule) {
      const inner = rule.styleSheet ? styles(rule.styleSheet.cssRules) : "";
      return rule.layerName ? `@layer ${rule.layerName} { ${inner} }` : inner;
    }
    return rule instanceof CSSFontFaceRule ? "" : rule.cssText;
  }).join("\n");

  const allStyles = () => [...document.styleSheets].map((sheet) => {
    try { return styles(sheet.cssRules); } catch { return ""; } // of another origin: none of the page's own
  }).join("\n");

  // a copy of the view: canvases as pictures, fields with what they hold, without what only a live page can do
  const copied = (view) => {
    const copy = view.cloneNode(true);
    const canvases = copy.querySelectorAll("canvas");
    view.querySelectorAll("canvas").forEach((canvas, i) => {
      const picture = new Image();
      if (canvas.width && canvas.height) picture.src = canvas.toDataURL("image/png");
      picture.style.cssText = `${canvas.style.cssText}; width: ${canvas.clientWidth}px; height: ${canvas.clientHeight}px`;
      canvases[i].replaceWith(picture);
    });
    const stages = copy.querySelectorAll(".tcbi-stage"); // as high as on the screen: heights of the window mean nothing in a file
    view.querySelectorAll(".tcbi-stage").forEach((stage, i) => { stages[i].style.height = `${stage.offsetHeight}px`; });
    const fields = copy.querySelectorAll("input");
    view.querySelectorAll("input").forEach((field, i) => fields[i].setAttribute("value", field.value));
    copy.querySelectorAll("button, .q-btn, .q-icon, script, .tcbi-picture").forEach((e) => e.remove());
    return copy;
  };

  const page = (view, title) => {
    const root = document.createElement("body");
    root.className = document.body.className;
    root.style.cssText = "margin: 0; padding: 16px; box-sizing: border-box";
    const heading = Object.assign(document.createElement("h1"), { textContent: title });
    heading.style.cssText = "font-size: 1.2rem; font-weight: 700; line-height: 2; margin: 0 0 8px";
    root.append(heading, copied(view));
    return root;
  };

  const save = (address, name) => Object.assign(document.createElement("a"), { href: address, download: name }).click();

  const picture = async (root, width, height, name) => {
    root.setAttribute("xmlns", "http://www.w3.org/1999/xhtml");
    const style = Object.assign(document.createElement("style"), { textContent: allStyles() });
    root.prepend(style);
    const drawing = `<svg xmlns="http://www.w3.org/2000/svg" width="${width}" height="${height}"><foreignObject width="100%"
      height="100%">${new XMLSerializer().serializeToString(root)}</foreignObject></svg>`;
    const image = new Image();
    image.src = `data:image/svg+xml;charset=utf-8,${encodeURIComponent(drawing)}`;
    await image.decode();
    const canvas = Object.assign(document.createElement("canvas"), { width: 2 * width, height: 2 * height });
    const context = canvas.getContext("2d");
    context.fillStyle = getComputedStyle(document.body).backgroundColor;
    context.fillRect(0, 0, canvas.width, canvas.height);
    context.drawImage(image, 0, 0, canvas.width, canvas.height);
    save(canvas.toDataURL("image/png"), `${name}.png`);
  };

  const saved = async (kind, title) => {
    const view = [...document.querySelectorAll(".tcbi-view")].find((e) => e.offsetParent !== null);
    const name = `tcbi-${title.toLowerCase()}`;
    const root = page(view, `tcbi: ${title}, ${new Date().toLocaleString("sv-SE")}`);
    const width = view.clientWidth + 32;
    if (kind === "png") return picture(root, width, view.scrollHeight + 90, name);
    root.style.cssText += `; max-width: ${width}px; margin: 0 auto`;
    const html = `<!doctype html><html lang="en"><head><meta charset="utf-8"><title>tcbi: ${title}</title>
      <meta name="viewport" content="width=device-width"><style>${allStyles()}</style></head>${root.outerHTML}</html>`;
    const address = URL.createObjectURL(new Blob([html], { type: "text/html" }));
    save(address, `${name}.html`);
    setTimeout(() => URL.revokeObjectURL(address), 10_000);
  };

  // "" or what went wrong
  window.tcbiSnapshot = (kind, title) => saved(kind, title).then(() => "", String);
})();
