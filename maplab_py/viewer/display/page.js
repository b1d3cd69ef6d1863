// Renderer, scene and camera of viser's page; null before there are any.
const viewerState = () => {
  let found = null;
  const root = window.__viserMutable && window.__viserMutable.scene;
  if (root) {
    root.traverse((node) => {
      if (!found && node.__r3f && node.__r3f.root) found = node.__r3f.root;
    });
  }
  return found && found.getState();
};

// Lets a function draw in the place of the renderer, which it is given with the renderer's own function.
const drawBy = (make) => {
  const wait = setInterval(() => {
    const state = viewerState();
    if (!state) return;
    clearInterval(wait);
    const gl = state.gl;
    const render = gl.render;
    gl.render = (...scene) => make(gl, () => render.apply(gl, scene));
  }, 20);
};

// Keeps the view fluent where drawing is slow: while the camera moves, fewer points are drawn with
// fewer pixels, without the grid, and with thin lines; the full picture is drawn again as soon as it
// rests. Where a program draws instead of a GPU this begins with the first movement, elsewhere once
// frames are slow. Software draws a part of the largest clouds at rest, too.
// Points arrive in a shuffled order, so that the first ones of a cloud are spread over all of it.
(() => {
  const SLOW_MS = 40; // a page that needs longer for a frame draws less
  const FAST_MS = 25;
  const REST_MS = 300;
  const STARTING_MS = 1500;
  const FEWEST_POINTS = 6000;
  const FIRST_POINTS = 20000; // in software, before frames are measured
  const REST_POINTS = 300000; // in software, while the camera rests
  const SMALL_MESH = 60000; // triangles, drawn as they are
  const CELLS = 80; // across a mesh that is drawn coarsely
  const LARGEST_FACTOR = 2; // on the size of the points that stand for all
  const SMALL_CLOUD = 2000; // drawn as it is
  const FAINT_LAYER = "/map/refused_closures/";
  const FAINT = 0.4; // opacity
  const SOFTWARE = /swiftshader|llvmpipe|softpipe|software|basic render/i;
  let budget = Infinity; // points that are drawn while the camera moves
  let isReduced = false;
  let isSoftware = null; // not known yet
  let pixelRatio = 1;
  let meanMs = 0.5 * SLOW_MS;
  let lastPose = "";
  let lastMove = -Infinity;
  let lastFrame = -1;
  let lastTime = 0;
  let isWatching = false;
  let isCapturing = false;

  const drawsInSoftware = () => {
    if (isSoftware === null && viewerState()) {
      const context = viewerState().gl.getContext();
      const info = context.getExtension("WEBGL_debug_renderer_info");
      const name = context.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : context.RENDERER);
      isSoftware = SOFTWARE.test(name);
    }
    return Boolean(isSoftware);
  };
  const clouds = () => {
    const found = [];
    window.__viserMutable.scene.traverse((node) => {
      const position = node.isPoints && node.geometry.attributes.position;
      if (position && position.count > SMALL_CLOUD) found.push([node, position.count]);
    });
    return found;
  };
  // draws the first points of a cloud alone, larger, so that they cover nearly what all of them do
  const drawPart = (cloud, count, part) => {
    const scale = cloud.material.uniforms && cloud.material.uniforms.scale;
    const factor = Math.min(LARGEST_FACTOR, Math.sqrt(1 / part));
    cloud.geometry.setDrawRange(0, part < 1 ? Math.ceil(part * count) : Infinity);
    cloud.onBeforeRender = part < 1 && scale ? () => (scale.value *= factor) : () => {};
    cloud.onAfterRender = part < 1 && scale ? () => (scale.value /= factor) : () => {};
  };
  const drawRest = () => {
    const all = clouds();
    const total = all.reduce((sum, [, count]) => sum + count, 0);
    const part = drawsInSoftware() && !isCapturing ? Math.min(1, REST_POINTS / Math.max(total, 1)) : 1;
    all.forEach(([cloud, count]) => drawPart(cloud, count, part));
  };
  // a cloud that arrives is limited before its first frame
  drawBy((gl, draw) => {
    if (!isReduced && drawsInSoftware()) drawRest();
    draw();
  });

  // The triangles between the cells of a grid, each cell at the first of its corners.
  const coarseIndex = (geometry) => {
    const { index, attributes } = geometry;
    geometry.computeBoundingBox();
    const { min, max } = geometry.boundingBox;
    const width = Math.max(max.x - min.x, max.y - min.y, max.z - min.z, 1e-9) / (CELLS - 1);
    const cornerOf = new Map();
    const corner = new Uint32Array(attributes.position.count);
    for (let row = 0; row < corner.length; row++) {
      const x = Math.floor((attributes.position.getX(row) - min.x) / width);
      const y = Math.floor((attributes.position.getY(row) - min.y) / width);
      const z = Math.floor((attributes.position.getZ(row) - min.z) / width);
      const cell = (x * CELLS + y) * CELLS + z;
      if (!cornerOf.has(cell)) cornerOf.set(cell, row);
      corner[row] = cornerOf.get(cell);
    }
    const kept = [];
    for (let face = 0; face < index.count; face += 3) {
      const [a, b, c] = [0, 1, 2].map((k) => corner[index.array[face + k]]);
      if (a !== b && b !== c && c !== a) kept.push(a, b, c);
    }
    return new index.constructor(new Uint32Array(kept), 1);
  };
  const setMeshes = (isCoarse) => {
    window.__viserMutable.scene.traverse(({ isMesh, isInstancedMesh, geometry }) => {
      if (!isMesh || isInstancedMesh || !geometry.index) return;
      const states = geometry.userData;
      if (!states.fine && (!isCoarse || geometry.index.count < 3 * SMALL_MESH)) return;
      if (!states.fine) Object.assign(states, { fine: geometry.index, coarse: coarseIndex(geometry) });
      geometry.setIndex(isCoarse ? states.coarse : states.fine);
    });
  };
  const setGround = (isVisible) => {
    const ground = window.__viserMutable.nodeRefFromName["/ground"];
    if (ground) ground.traverse((node) => (isVisible ? node.layers.enable(0) : node.layers.disable(0)));
  };

  // Wide lines are instances of a small mesh, which software draws one after the other: 2000 of them
  // take longer than 50,000 points. Lines of one pixel, at half the pixel ratio, look nearly alike.
  const parent = (class_) => Object.getPrototypeOf(class_);
  const makeThinLines = (wide) => {
    const { instanceStart, instanceColorStart, position } = wide.geometry.attributes;
    const Geometry = parent(parent(wide.geometry.constructor));
    const Material = parent(wide.material.constructor);
    const Mesh = parent(wide.constructor);
    const geometry = new Geometry();
    const set = (name, source) =>
      geometry.setAttribute(name, new position.constructor(source.data.array, 3));
    set("position", instanceStart);
    if (instanceColorStart) set("color", instanceColorStart);
    const material = new Material({
      vertexColors: Boolean(instanceColorStart),
      transparent: wide.material.transparent,
      depthWrite: wide.material.depthWrite,
      uniforms: { plain: { value: wide.material.color }, alpha: { value: wide.material.opacity } },
      vertexShader: `
        uniform vec3 plain;
        varying vec3 lineColor;
        void main() {
          lineColor = plain;
          #ifdef USE_COLOR
            lineColor *= color;
          #endif
          gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
        }`,
      fragmentShader: `
        uniform float alpha;
        varying vec3 lineColor;
        void main() {
          gl_FragColor = vec4(lineColor, alpha);
          #include <colorspace_fragment>
        }`,
    });
    const thin = new Mesh(geometry, material);
    Object.assign(thin, { isMesh: false, isLine: true, isLineSegments: true, frustumCulled: false });
    thin.raycast = () => {};
    thin.isThin = true;
    thin.source = instanceStart;
    return thin;
  };
  const release = (thin) => {
    thin.removeFromParent();
    thin.geometry.dispose();
    thin.material.dispose();
  };
  const thinLines = () => {
    const wide = [];
    window.__viserMutable.scene.traverse((node) => {
      if (node.isLineSegments2) wide.push(node);
    });
    wide.forEach((node) => {
      const source = node.geometry.attributes.instanceStart;
      let thin = node.children.find((child) => child.isThin);
      if (thin && thin.source !== source) {
        release(thin);
        thin = undefined;
      }
      if (!source) return;
      if (!thin) {
        thin = makeThinLines(node);
        node.add(thin);
        node.geometry.addEventListener("dispose", () => release(thin));
      }
      thin.visible = true;
      node.layers.disable(0);
    });
  };
  const widenLines = () => {
    window.__viserMutable.scene.traverse((node) => {
      if (node.isLineSegments2) node.layers.enable(0);
      if (node.isThin) node.visible = false;
    });
  };

  const reduce = () => {
    const all = clouds();
    const total = all.reduce((sum, [, count]) => sum + count, 0);
    if (budget === Infinity) {
      budget = drawsInSoftware() ? FIRST_POINTS : Math.max(FEWEST_POINTS, 0.2 * total);
    }
    const part = Math.min(1, budget / Math.max(total, 1));
    all.forEach(([cloud, count]) => drawPart(cloud, count, part));
    const state = viewerState();
    if (!state) return;
    if (isReduced) {
      // viser changes the ratio of slow pages
      if (state.gl.getPixelRatio() !== 0.5 * pixelRatio) state.setDpr(0.5 * pixelRatio);
      return;
    }
    isReduced = true;
    pixelRatio = state.gl.getPixelRatio();
    state.setDpr(0.5 * pixelRatio);
    setGround(false);
    thinLines();
    setMeshes(true);
  };
  const restore = () => {
    isReduced = false;
    drawRest();
    const state = viewerState();
    if (state) state.setDpr(pixelRatio);
    setGround(true);
    widenLines();
    setMeshes(false);
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
    if (isCapturing || now - lastMove > REST_MS) {
      isWatching = false;
      if (isReduced) restore();
      return;
    }
    const frame = testpoints.rendererInfo.render.frame;
    if (lastFrame >= 0 && frame > lastFrame) adapt((now - lastTime) / (frame - lastFrame));
    if (frame !== lastFrame) lastTime = now;
    lastFrame = frame;
    requestAnimationFrame(watch);
  };

  const begin = () => {
    if (isWatching || isCapturing) return;
    isWatching = true;
    lastMove = performance.now();
    lastFrame = -1;
    if (budget < Infinity || drawsInSoftware()) reduce();
    requestAnimationFrame(watch);
  };
  let readyAt = Infinity; // the camera is aimed while the first picture is made
  setInterval(() => {
    if (isWatching || !hasMoved()) return;
    if (readyAt === Infinity) readyAt = performance.now() + STARTING_MS;
    if (performance.now() > readyAt) begin();
  }, 50);

  // a picture that the console asks for is a full one
  let testpoints;
  Object.defineProperty(window, "__viserTestpoints", {
    configurable: true,
    get: () => testpoints,
    set: (value) => {
      testpoints = value;
      const mutable = window.__viserMutable;
      let state = mutable.getRenderRequestState;
      Object.defineProperty(mutable, "getRenderRequestState", {
        configurable: true,
        get: () => state,
        set: (next) => {
          state = next;
          isCapturing = next !== "ready";
          if (isCapturing && isReduced) restore();
        },
      });
    },
  });

  // viser draws lines opaque only
  setInterval(() => {
    const nodes = window.__viserMutable ? window.__viserMutable.nodeRefFromName : {};
    Object.keys(nodes).forEach((name) => {
      if (!name.startsWith(FAINT_LAYER) || !nodes[name]) return;
      nodes[name].traverse(({ isLineSegments2, material }) => {
        if (!isLineSegments2 || material.transparent) return;
        Object.assign(material, { transparent: true, depthWrite: false, opacity: FAINT });
        material.needsUpdate = true;
        window.__viserMutable.requestRender();
      });
    });
  }, 200);

  // where drawing is slow, the first frame of a movement shall not be a full one
  const expectMovement = (event) => {
    const isTurning = event.type === "wheel" || (event.type === "pointermove" && event.buttons);
    if (isTurning && event.target.tagName === "CANVAS" && drawsInSoftware()) begin();
  };
  window.addEventListener("pointermove", expectMovement, { capture: true, passive: true });
  window.addEventListener("wheel", expectMovement, { capture: true, passive: true });
})();

// Lets the first picture come sooner: logs of shaders, each of which waits for the process that draws,
// are read of those alone that failed.
(() => {
  if (!window.WebGL2RenderingContext) return;
  const context = WebGL2RenderingContext.prototype;
  const { getProgramInfoLog, getShaderInfoLog } = context;
  let hasFailed = false;
  context.getProgramInfoLog = function (program) {
    hasFailed = !this.getProgramParameter(program, this.LINK_STATUS);
    return hasFailed ? getProgramInfoLog.call(this, program) : "";
  };
  context.getShaderInfoLog = function (shader) {
    return hasFailed ? getShaderInfoLog.call(this, shader) : "";
  };
})();

// Colours of the grid, which viser has from the server, in pages that are dark.
(() => {
  const COLOURS = { light: [0xeceef1, 0xdadde2], dark: [0x2a2c30, 0x3a3d42] };
  setInterval(() => {
    const ground = window.__viserMutable && window.__viserMutable.nodeRefFromName["/ground"];
    if (!ground) return;
    const theme = document.documentElement.dataset.mantineColorScheme || "light";
    const [cell, section] = COLOURS[theme];
    ground.traverse(({ material }) => {
      const uniforms = material && material.uniforms; // viser may have set them again
      if (!uniforms || !uniforms.cellColor || uniforms.cellColor.value.getHex() === cell) return;
      uniforms.cellColor.value.set(cell);
      uniforms.sectionColor.value.set(section);
      window.__viserMutable.requestRender();
    });
  }, 100);
})();

// Swipe line: left of it another state or map, which is in layers whose names begin so, right of it the map.
(() => {
  const OTHER = "/map/swiped_";
  const MAP = /^\/(map|history|play)\//;
  let share = 0.5; // of the picture's width
  let line = null;
  let canvas = null;

  const place = () => {
    const box = canvas.getBoundingClientRect();
    line.style.left = `${box.left + share * box.width - 15}px`;
    line.setAttribute("aria-valuenow", Math.round(100 * share));
  };
  const moveTo = (wanted) => {
    share = Math.min(0.98, Math.max(0.02, wanted));
    place();
    window.__viserMutable.requestRender();
  };
  const show = () => {
    line = document.createElement("div");
    line.className = "maplab-swipe";
    Object.entries({ role: "slider", tabindex: 0, "aria-label": "swipe line" }).forEach((pair) =>
      line.setAttribute(...pair),
    );
    line.addEventListener("pointerdown", (event) => line.setPointerCapture(event.pointerId));
    line.addEventListener("pointermove", (event) => {
      const box = canvas.getBoundingClientRect();
      if (event.buttons) moveTo((event.clientX - box.left) / box.width);
    });
    line.addEventListener("keydown", (event) => {
      const step = { ArrowLeft: -0.02, ArrowRight: 0.02 }[event.key];
      if (step) moveTo(share + step);
      if (step) event.stopPropagation();
    });
    document.body.append(line);
    place();
    window.addEventListener("resize", place);
  };
  const hide = () => {
    window.removeEventListener("resize", place);
    line.remove();
    line = null;
  };

  // draws the picture in two halves, each without the nodes of the other
  drawBy((gl, draw) => {
    canvas = gl.domElement;
    if (!line || gl.getRenderTarget() !== null) {
      draw();
      return;
    }
    const nodes = window.__viserMutable.nodeRefFromName;
    const size = gl.getSize({ set: (width, height) => [width, height] });
    const without = (isHidden, x, width) => {
      const hidden = Object.keys(nodes).filter((name) => nodes[name] && nodes[name].visible && isHidden(name));
      hidden.forEach((name) => (nodes[name].visible = false));
      gl.setScissor(x, 0, width, size[1]);
      draw();
      hidden.forEach((name) => (nodes[name].visible = true));
    };
    const cut = Math.round(share * size[0]);
    gl.setScissorTest(true);
    without((name) => MAP.test(name) && !name.startsWith(OTHER), 0, cut);
    without((name) => name.startsWith(OTHER), cut, size[0] - cut);
    gl.setScissorTest(false);
  });
  setInterval(() => {
    if (!canvas) return;
    const nodes = window.__viserMutable.nodeRefFromName;
    const isPart = (name) => name.startsWith(OTHER) && name.split("/").length > 3; // groups of none stay
    const isWanted = Object.keys(nodes).some((name) => isPart(name) && nodes[name]);
    if (isWanted !== Boolean(line)) (isWanted ? show : hide)();
  }, 200);
})();

// A key that is held plays or pauses once.
window.addEventListener(
  "keydown",
  (event) => {
    if (event.code !== "Space" || !event.repeat) return;
    if (/^(INPUT|TEXTAREA)$/.test(event.target.tagName)) return;
    event.preventDefault(); // a button would be pressed
    event.stopImmediatePropagation();
  },
  { capture: true },
);

// Lets the server read and write the page's address: of the messages of one page that viser has, those
// of local storage do both. Behind the # is a view that was shared (links.py).
(() => {
  const KEY = /maplab_link$/;
  const { getItem, setItem } = Storage.prototype;
  let link = location.hash.slice(1); // told once: a page that connects again keeps its view
  // viser would take what is behind the # for a part of the server's address
  if (link && location.protocol !== "file:") history.replaceState(null, "", location.href.split("#")[0]);
  // the theme is one of the page, not of all of its origin, and at first the system's
  const THEME = /maplab_theme$/;
  const systemTheme = () => (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "");
  Storage.prototype.getItem = function (key) {
    if (THEME.test(key)) return getItem.call(sessionStorage, key) || systemTheme();
    if (!KEY.test(key)) return getItem.call(this, key);
    const told = link;
    link = "";
    return told;
  };
  Storage.prototype.setItem = function (key, value) {
    if (THEME.test(key)) return setItem.call(sessionStorage, key, value);
    if (!KEY.test(key)) return setItem.call(this, key, value);
    history.replaceState(null, "", `#${value}`);
    if (navigator.clipboard) navigator.clipboard.writeText(location.href).catch(() => {});
  };
  window.addEventListener("hashchange", () => location.reload());
})();
