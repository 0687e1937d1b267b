// A page of one file: a scene in 3D with its styles, or pictures of it where there is no WebGL 2 or no Gaussians.

const FIRST_PICTURE_MS = 3000; // that other styles wait for it: a page in the background draws none

/**
 * What lies in the page (writer.py): the scene's head, its styles, small pictures of their photographs, pictures of each style.
 * @typedef {{scene: (SplatHead & PlaceHead & {light?: DayHead})?,
 *   styles: (ColourHead & {name: string, of: string[], lit?: boolean})[],
 *   references: Object<string, string>, stills: Object<string, string[]>}} PageData
 */

/** Pictures in the place of a scene: views by styles, one over the other. */
class Pictures {
  /** @param {HTMLElement} root @param {Object<string, string[]>} stills */
  constructor(root, stills) {
    this.stills = stills;
    this.at = 0;
    /** @type {Shown} */
    this.shown = { first: null, second: null, blend: 1, wipe: -1 };
    this.images = [...root.querySelectorAll("img")].filter((image) => image.classList.contains("still"));
    this.images.forEach((image) => { image.hidden = false; });
    this.count = Math.max(1, ...Object.values(stills).map((rows) => rows.length));
  }

  /** The picture of a style at this view. @param {string} name */
  source(name) {
    const rows = this.stills[name] ?? Object.values(this.stills)[0];
    return rows[this.at % rows.length];
  }

  /** @param {Partial<Shown>} changes */
  show(changes) {
    Object.assign(this.shown, changes);
    const { first, second, blend, wipe } = this.shown;
    const under = first ?? second ?? "";
    const over = second ?? under;
    const [one, two] = this.images;
    one.src = this.source(under);
    two.src = this.source(over);
    two.style.opacity = String(wipe >= 0 ? 1 : blend);
    two.style.clipPath = wipe >= 0 ? `inset(0 0 0 ${100 * wipe}%)` : "none";
    one.alt = `${under}, ${over}`;
  }

  /** @param {number} by */
  step(by) {
    this.at = (this.at + by + this.count) % this.count;
    this.show({});
  }

  home() {
    this.at = 0;
    this.show({});
  }
}

/** Bytes that lie in the page. @param {string} name */
const section = (name) => {
  const text = atob((at(`data-${name}`).textContent ?? "").trim());
  return Uint8Array.from(text, (letter) => letter.charCodeAt(0));
};

/** Pictures in the place of the scene. @param {PageData} data @param {string} why */
const fallBack = (data, why) => {
  const root = at("place");
  root.classList.add("pictures");
  explain(root, why && `${capital(why)}. Pictures stand in the place of the scene.`);
  at("canvas").hidden = true;
  const pictures = new Pictures(root, data.stills);
  at("back").hidden = pictures.count < 2;
  at("next").hidden = pictures.count < 2;
  return pictures;
};

/** The scene in 3D, or pictures of it. @param {PageData} data @returns {Promise<Place|Pictures>} */
const placeOf = async (data) => {
  if (!data.scene) return fallBack(data, "");
  try {
    const splats = new Splats(at("canvas"));
    await splats.load(data.scene, { shape: section("shape"), chunks: section("chunks"), palette: section("palette") });
    await splats.add(data.styles[0].name, data.styles[0], section("style-0"));
    return new Place(at("canvas"), data.scene, splats);
  } catch (error) {
    return fallBack(data, wordsOf(error));
  }
};

/** Other styles are read after the first picture. @param {Place} place @returns {Promise<void>} */
const firstPicture = (place) => new Promise((done) => {
  const root = at("place");
  place.listeners.lost = (lost) => {
    root.classList.toggle("drawn", !lost);
    explain(root, lost ? LOST : "");
  };
  place.listeners.drawn = () => {
    root.classList.add("drawn");
    done();
  };
  setTimeout(done, FIRST_PICTURE_MS);
});

/** The light of a day on the first style. @param {PageData} data @param {Stage} stage */
const bringLight = async (data, stage) => {
  if (!(stage.place instanceof Place) || !data.scene?.light) return;
  stage.light = new Daylight(stage.place, data.scene.light, await inflate(section("light")));
  for (const button of every("[data-light=moonlight]", HTMLElement)) button.hidden = true; // of it nothing was computed
  stage.light.cover(data.styles[0].name);
};

/** @param {PageData} data */
const openPage = async (data) => {
  const place = await placeOf(data);
  const splats = place instanceof Place ? place.splats : null;
  const styles = data.styles.map(({ name, of }) => ({ name, thumb: data.stills[name][0], of: of.map((each) => data.references[each]) }));
  const stage = new Stage(place, styles.slice(0, 1));
  await bringLight(data, stage);
  Object.assign(window, { fprf: { place, stage } });
  if (place instanceof Place) await firstPicture(place);
  for (const [k, style] of styles.entries()) {
    if (k === 0) continue;
    if (splats) {
      await splats.add(style.name, data.styles[k], section(`style-${k}`));
      await pause(0); // a picture between two styles
    }
    stage.add(style);
    if (!data.styles[k].lit) stage.light?.cover(style.name);
    if (k === 1 && !location.hash) stage.begin(style.name);
  }
  if (location.hash && !stage.sending.read() && styles.length > 1) stage.begin(styles[1].name);
  at("place").classList.add("ready");
};
