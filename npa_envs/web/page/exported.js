// The page by itself: over the engine in the browser, behind pictures to choose from where it has some.

import { connect } from "./engine_browser.js";
import { start } from "./page.js";

// Begins with what the page holds in its element `rules`.
export function begin() {
  const settings = JSON.parse(document.getElementById("rules").textContent);
  const pictured = settings.rules.filter((rule) => rule.preview);
  if (pictured.length === 0) start(connect, settings);
  else new Gallery(settings, pictured);
}

// The address says what is seen: "#gecko" that rule's world, no name all pictures.
class Gallery {
  constructor(settings, pictured) {
    this.settings = settings;
    this.page = null;
    this.stage = document.querySelector("main");
    this.grid = document.createElement("section");
    this.grid.id = "gallery";
    const title = document.createElement("h1");
    title.textContent = document.title;
    const hint = document.createElement("p");
    hint.textContent =
      "Small neural networks, one in every particle. Choose one, watch it grow, then remove a part of it.";
    const list = document.createElement("ul");
    for (const { name, preview } of pictured) {
      const item = document.createElement("li"), link = document.createElement("a");
      const picture = new Image(), caption = document.createElement("span");
      Object.assign(picture, { src: preview, alt: "" });
      caption.textContent = name;
      link.href = `#${encodeURIComponent(name)}`;
      link.append(picture, caption);
      item.append(link);
      list.append(item);
    }
    this.grid.append(title, hint, list);
    this.back = document.createElement("a");
    Object.assign(this.back, { id: "back", href: "#", textContent: "All rules" });
    document.body.append(this.grid, this.back);
    addEventListener("hashchange", () => this.show());
    this.show();
  }

  async show() {
    const wanted = decodeURIComponent(location.hash.slice(1));
    const chosen = this.settings.rules.find(({ name }) => name === wanted);
    this.stage.hidden = this.back.hidden = chosen === undefined;
    this.grid.hidden = chosen !== undefined;
    if (chosen === undefined) {
      this.page?.play(false);
    } else if (this.page === null) {
      const others = this.settings.rules.filter((rule) => rule !== chosen);
      this.page = await start(connect, { ...this.settings, rules: [chosen, ...others] });
    } else {
      // The world tells whether it runs when its rule is set.
      this.page.play(true);
      this.page.send({ type: "set", name: "rule", value: chosen.name });
    }
  }
}
