// Keeps the view fluent where drawing is slow: while the camera moves, fewer points are drawn with
// fewer pixels and without the grid; the full picture is drawn again as soon as it rests.
// Points arrive in a shuffled order, so that the first ones of a cloud are spread over all of it.
(() => {
  const SLOW_MS = 40; // a page that needs longer for a frame draws less
  const FAST_MS = 25;
  const REST_MS = 500;
  const FEWEST_POINTS = 10000;
  const SMALL_CLOUD = 2000; // drawn as it is
  let budget = Infinity; // points that are drawn while the camera moves
  let isReduced = false;
  let pixelRatio = 1;
  let meanMs = 0.5 * SLOW_MS;
  let lastPose = "";
  let lastMove = -Infinity;
  let lastFrame = -1;
  let lastTime = 0;
  let isWatching = false;

  const store = () => {
    let found = null;
    window.__viserMutable.scene.traverse((node) => {
      if (!found && node.__r3f && node.__r3f.root) found = node.__r3f.root;
    });
    return found && found.getState();
  };
  const clouds = () => {
    const found = [];
    window.__viserMutable.scene.traverse((node) => {
      const position = node.isPoints && node.geometry.attributes.position;
      if (position && position.count > SMALL_CLOUD) found.push([node.geometry, position.count]);
    });
    return found;
  };
  const setGround = (isVisible) => {
    const ground = window.__viserMutable.nodeRefFromName["/ground"];
    if (ground) ground.traverse((node) => (isVisible ? node.layers.enable(0) : node.layers.disable(0)));
  };

  const reduce = () => {
    const all = clouds();
    const total = all.reduce((sum, [, count]) => sum + count, 0);
    if (budget === Infinity) budget = Math.max(FEWEST_POINTS, 0.2 * total);
    const part = Math.min(1, budget / Math.max(total, 1));
    all.forEach(([geometry, count]) => geometry.setDrawRange(0, Math.ceil(part * count)));
    if (isReduced) return;
    isReduced = true;
    const state = store();
    if (!state) return;
    pixelRatio = state.gl.getPixelRatio();
    state.setDpr(0.5 * pixelRatio);
    setGround(false);
  };
  const restore = () => {
    isReduced = false;
    clouds().forEach(([geometry]) => geometry.setDrawRange(0, Infinity));
    const state = store();
    if (state) state.setDpr(pixelRatio);
    setGround(true);
    window.__viserMutable.requestRender();
  };

  const adapt = (frameMs) => {
    meanMs += 0.4 * (frameMs - meanMs);
    if (budget === Infinity) {
      if (meanMs > SLOW_MS) reduce();
      return;
    }
    if (meanMs > SLOW_MS) budget = Math.max(FEWEST_POINTS, 0.7 * budget);
    else if (meanMs < FAST_MS) budget *= 1.2;
    const total = clouds().reduce((sum, [, count]) => sum + count, 0);
    if (budget < 4 * total || !isReduced) {
      reduce();
      return;
    }
    budget = Infinity; // it was slow for another reason
    restore();
  };

  const hasMoved = () => {
    const camera = window.__viserMutable && window.__viserMutable.camera;
    if (!camera) return false;
    const pose = camera.matrixWorld.elements.map((x) => x.toFixed(5)).join();
    const moved = lastPose !== "" && pose !== lastPose;
    lastPose = pose;
    return moved;
  };

  const watch = () => {
    const now = performance.now();
    if (hasMoved()) lastMove = now;
    if (now - lastMove > REST_MS) {
      isWatching = false;
      if (isReduced) restore();
      return;
    }
    const frame = window.__viserTestpoints.rendererInfo.render.frame;
    if (lastFrame >= 0 && frame > lastFrame) adapt((now - lastTime) / (frame - lastFrame));
    if (frame !== lastFrame) lastTime = now;
    lastFrame = frame;
    requestAnimationFrame(watch);
  };

  setInterval(() => {
    if (isWatching || !hasMoved()) return;
    isWatching = true;
    lastMove = performance.now();
    lastFrame = -1;
    if (budget < Infinity) reduce();
    requestAnimationFrame(watch);
  }, 50);
})();
