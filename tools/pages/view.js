(() => {
  "use strict";
  const canvas = document.getElementById("view"), scene = JSON.parse(document.getElementById("scene").textContent);
  const gl = canvas.getContext("webgl", { antialias: true });
  if (!gl) { canvas.replaceWith("This browser has no WebGL; the path from above is drawn below."); return; }
  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer;
  const shader = (kind, source) => { const s = gl.createShader(kind); gl.shaderSource(s, source); gl.compileShader(s); return s; };
  const program = gl.createProgram();
  gl.attachShader(program, shader(gl.VERTEX_SHADER, "attribute vec3 p; attribute vec4 c; uniform mat4 m; uniform float s; varying vec4 v; void main() { v = c; gl_Position = m * vec4(p, 1.0); gl_PointSize = s; }"));
  gl.attachShader(program, shader(gl.FRAGMENT_SHADER, "precision mediump float; varying vec4 v; void main() { gl_FragColor = v; }"));
  gl.linkProgram(program); gl.useProgram(program); gl.enable(gl.BLEND); gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ONE, gl.ONE);
  const at = { p: gl.getAttribLocation(program, "p"), c: gl.getAttribLocation(program, "c"), m: gl.getUniformLocation(program, "m"), s: gl.getUniformLocation(program, "s") };
  const buffer = (target, data) => { const b = gl.createBuffer(); gl.bindBuffer(target, b); gl.bufferData(target, data, gl.STATIC_DRAW); return b; };
  const drawn = [], boxes = [...document.querySelectorAll("input.layer")];
  scene.meshes.forEach((mesh, k) => {
    const vertices = new Int16Array(bytes(mesh.vertices)), triangles = mesh.triangles && new Uint16Array(bytes(mesh.triangles));
    drawn.push({ box: boxes[k], points: vertices, mode: gl.TRIANGLES, count: triangles ? triangles.length : vertices.length / 3, index: triangles && buffer(gl.ELEMENT_ARRAY_BUFFER, triangles),
      p: buffer(gl.ARRAY_BUFFER, vertices), c: buffer(gl.ARRAY_BUFFER, new Uint8Array(bytes(mesh.colors))) });
  });
  scene.paths.forEach((path, k) => {
    const points = new Int16Array(bytes(path.positions_m)), count = points.length / 3, color = [1, 3, 5].map((i) => parseInt(path.color.slice(i, i + 2), 16));
    const colors = Uint8Array.from({ length: 4 * count }, (_, i) => [...color, 255][i % 4]);
    const one = { box: boxes[scene.meshes.length + k], points, count, p: buffer(gl.ARRAY_BUFFER, points), c: buffer(gl.ARRAY_BUFFER, colors) };
    drawn.push({ ...one, mode: path.dashes ? gl.LINES : gl.LINE_STRIP });
    if (path.dot_px) drawn.push({ ...one, mode: gl.POINTS, size: path.dot_px });
  });
  const start = { yaw: 0.5, pitch: 0.5, x: 0, y: 0, distance: 1.45 }, focal = 1.7, filled = 0.92;
  let eye = { ...start };
  const multiply = (a, b) => { const o = new Float32Array(16); for (let c = 0; c < 4; c++) for (let r = 0; r < 4; r++) for (let k = 0; k < 4; k++) o[4 * c + r] += a[4 * k + r] * b[4 * c + k]; return o; };
  // Turns the scene, which has z up, into x right, y up, z towards the viewer.
  const turn = (yaw, pitch) => {
    const cy = Math.cos(yaw), sy = Math.sin(yaw), cp = Math.cos(pitch), sp = Math.sin(pitch);
    return [cy, -sy, 0, sy * sp, cy * sp, cp, -sy * cp, -cy * cp, sp];
  };
  // Moves the viewer to where all that is ticked just fits: each point asks for a distance, and the middle is that of their directions.
  function fit() {
    eye = { ...start };
    const r = turn(eye.yaw, eye.pitch), seen = [], fx = focal * canvas.clientHeight / canvas.clientWidth / filled, fy = focal / filled;
    for (const { points } of drawn.filter((layer) => layer.box.checked)) {
      const step = 3 * Math.ceil(points.length / 60000);
      for (let i = 0; i < points.length; i += step) seen.push([0, 3, 6].map((k) => (r[k] * points[i] + r[k + 1] * points[i + 1] + r[k + 2] * points[i + 2]) / 32767));
    }
    if (!seen.length) return;
    const between = (k, f) => { // the edges of the frustum in the plane of an axis: x = ±(distance - z) / f + middle
      const ends = [1, -1].map((side) => seen.reduce((most, p) => Math.max(most, side * p[k] * f + p[2]), -Infinity));
      return { middle: 0.5 * (ends[0] - ends[1]) / f, distance: 0.5 * (ends[0] + ends[1]) };
    };
    const across = between(0, fx), up = between(1, fy);
    Object.assign(eye, { x: across.middle, y: up.middle, distance: Math.max(across.distance, up.distance, 0.05) });
  }
  function matrix() {
    const f = focal, near = 0.02, far = 20, aspect = canvas.clientWidth / canvas.clientHeight, r = turn(eye.yaw, eye.pitch);
    const projection = new Float32Array([f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) / (near - far), -1, 0, 0, 2 * far * near / (near - far), 0]);
    const view = new Float32Array([r[0], r[3], r[6], 0, r[1], r[4], r[7], 0, r[2], r[5], r[8], 0, -eye.x, -eye.y, -eye.distance, 1]);
    const s = 1 / 32767;
    return multiply(projection, multiply(view, new Float32Array([s, 0, 0, 0, 0, s, 0, 0, 0, 0, s, 0, 0, 0, 0, 1])));
  }
  function draw() {
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    canvas.width = canvas.clientWidth * ratio; canvas.height = canvas.clientHeight * ratio;
    gl.viewport(0, 0, canvas.width, canvas.height); gl.clearColor(0.93, 0.94, 0.95, 1); gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.uniformMatrix4fv(at.m, false, matrix());
    for (const one of drawn.filter((layer) => layer.box.checked)) {
      if (one.mode === gl.TRIANGLES) gl.enable(gl.DEPTH_TEST); else gl.disable(gl.DEPTH_TEST);
      gl.uniform1f(at.s, one.size || 1);
      gl.bindBuffer(gl.ARRAY_BUFFER, one.p); gl.enableVertexAttribArray(at.p); gl.vertexAttribPointer(at.p, 3, gl.SHORT, false, 0, 0);
      gl.bindBuffer(gl.ARRAY_BUFFER, one.c); gl.enableVertexAttribArray(at.c); gl.vertexAttribPointer(at.c, 4, gl.UNSIGNED_BYTE, true, 0, 0);
      if (one.index) { gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, one.index); gl.drawElements(one.mode, one.count, gl.UNSIGNED_SHORT, 0); } else gl.drawArrays(one.mode, 0, one.count);
    }
  }
  const change = (yaw, pitch, zoom) => {
    eye.yaw += yaw; eye.pitch = Math.min(1.55, Math.max(-1.55, eye.pitch + pitch)); eye.distance = Math.min(8, Math.max(0.05, eye.distance * zoom)); requestAnimationFrame(draw);
  };
  const keys = { ArrowLeft: [-0.1, 0, 1], ArrowRight: [0.1, 0, 1], ArrowUp: [0, 0.1, 1], ArrowDown: [0, -0.1, 1], "+": [0, 0, 0.9], "=": [0, 0, 0.9], "-": [0, 0, 1.1] };
  canvas.addEventListener("keydown", (event) => {
    if (event.key === "0") { fit(); change(0, 0, 1); event.preventDefault(); }
    if (keys[event.key]) { change(...keys[event.key]); event.preventDefault(); }
  });
  let last = null;
  canvas.addEventListener("pointerdown", (event) => { last = event; canvas.setPointerCapture(event.pointerId); });
  canvas.addEventListener("pointerup", () => { last = null; });
  canvas.addEventListener("pointermove", (event) => { if (last) { change(0.008 * (event.clientX - last.clientX), 0.008 * (event.clientY - last.clientY), 1); last = event; } });
  canvas.addEventListener("wheel", (event) => { if (document.activeElement === canvas) { change(0, 0, event.deltaY > 0 ? 1.1 : 0.9); event.preventDefault(); } }, { passive: false });
  const refit = () => { fit(); draw(); };
  window.addEventListener("resize", refit);
  for (const box of boxes) box.addEventListener("change", refit);
  refit();
})();
