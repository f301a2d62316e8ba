// Viewers sort beside drawing: the picture is the one that no longer changes.
export async function settled(draw, canvas) {
  const { width, height } = canvas;
  const page = new OffscreenCanvas(width, height).getContext("2d");
  let before, same = 0;
  for (let k = 0; k < 60 && same < 4; k++) {
    // A canvas can only be read before the browser has taken it, and lies on a black page.
    await new Promise((done) => requestAnimationFrame(() => {
      draw();
      page.fillRect(0, 0, width, height);
      page.drawImage(canvas, 0, 0);
      done();
    }));
    await new Promise((done) => setTimeout(done, 250));
    const now = page.getImageData(0, 0, width, height).data;
    same = k > 4 && now.every((value, i) => value === before[i]) ? same + 1 : 0;
    before = now;
  }
  const blob = await page.canvas.convertToBlob();
  return new Promise((done) => {
    const reader = new FileReader();
    reader.onload = () => done(reader.result);
    reader.readAsDataURL(blob);
  });
}
