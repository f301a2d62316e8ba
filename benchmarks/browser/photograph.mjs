// Reads an order of shots from standard input, draws them in headless Chromium, writes PNG files.
import { readFileSync, writeFileSync } from "node:fs";

const order = JSON.parse(readFileSync(0, "utf8"));
const { chromium } = await import(order.playwright);
const browser = await chromium.launch({ executablePath: order.chromium, args: order.arguments });
const measured = {};
let page = null, shown = null;
for (const shot of order.shots) {
  const viewer = !shot.page.startsWith("avatar");
  // A viewer is loaded anew for each picture, an avatar page once.
  if (viewer || shown !== shot.page) {
    await page?.close();
    page = await browser.newPage();
    page.setDefaultTimeout(300000);
    page.on("pageerror", (error) => console.error(String(error)));
    await page.goto(`${order.address}/${shot.page}`);
    shown = shot.page;
  }
  let url;
  if (viewer) {
    await page.waitForFunction("globalThis.photograph");
    url = await page.evaluate((given) => photograph(given), shot);
  } else {
    await page.waitForFunction("globalThis.avatarPlayer");
    [url, measured.avatar_ms] = await page.evaluate(({ clip, seconds, camera, timed }) => {
      avatarPlayer.chooseClip(clip);
      avatarPlayer.seek(seconds);
      avatarPlayer.look(camera);
      const canvas = document.getElementById("picture"), url = canvas.toDataURL();
      // Reading a pixel waits for the drawing.
      const gl = canvas.getContext("webgl2"), pixel = new Uint8Array(4);
      let best = Infinity;
      for (let k = 0; k < timed; k++) {
        const before = performance.now();
        avatarPlayer.draw();
        gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
        best = Math.min(best, performance.now() - before);
      }
      return [url, best];
    }, shot);
  }
  writeFileSync(`${order.out}/${shot.picture}`, Buffer.from(url.split(",")[1], "base64"));
}
await browser.close();
console.log(JSON.stringify(measured));
