(() => {
  const canvas = document.getElementById("room"), pen = canvas.getContext("2d");
  const all = R.path.concat(R.stations.map(s => s.p), R.box);
  const low = [0, 1, 2].map(k => Math.min(...all.map(p => p[k])));
  const high = [0, 1, 2].map(k => Math.max(...all.map(p => p[k])));
  const middle = low.map((l, k) => (l + high[k]) / 2);
  const size = Math.hypot(...low.map((l, k) => high[k] - l));
  let turn = 0.7, lean = 0.45, zoom = 1;
  const at = p => {
    const [x, y, z] = p.map((v, k) => v - middle[k]);
    const a = x * Math.cos(turn) - y * Math.sin(turn), b = x * Math.sin(turn) + y * Math.cos(turn);
    const scale = zoom * 1.05 * canvas.height / size;
    return [canvas.width / 2 + scale * a, canvas.height / 2 - scale * (z * Math.cos(lean) + b * Math.sin(lean))];
  };
  const line = (points, colour, width) => {
    pen.beginPath();
    points.forEach((p, n) => pen[n ? "lineTo" : "moveTo"](...at(p)));
    pen.strokeStyle = colour;
    pen.lineWidth = width;
    pen.stroke();
  };
  const word = (p, text, colour) => {
    pen.fillStyle = colour;
    pen.font = "bold 14px Helvetica, Arial, sans-serif";
    const [x, y] = at(p);
    pen.fillText(text, x + 8, y - 8);
  };
  const draw = () => {
    pen.clearRect(0, 0, canvas.width, canvas.height);
    const corner = n => [0, 1, 2].map(k => R.box[n >> k & 1][k]);
    for (let n = 0; n < 8; n++)
      for (let k = 0; k < 3; k++) if (!(n >> k & 1)) line([corner(n), corner(n | 1 << k)], "#cbd2d9", 1);
    ["x", "y", "z"].forEach((name, k) => {
      const tip = R.box[0].map((v, j) => v + (j === k ? 0.25 * (R.box[1][k] - v) : 0));
      line([R.box[0], tip], "#68747f", 2.5);
      word(tip, name, "#68747f");
    });
    R.rays.forEach((rays, s) => rays.forEach(ray => line(ray, s ? "#2f855a55" : "#2b6cb055", 1)));
    if (!R.places) line(R.path, "#1f2933", 1);
    else R.path.forEach(p => {
      pen.beginPath();
      pen.arc(...at(p), 3, 0, 7);
      pen.fillStyle = "#1f2933";
      pen.fill();
    });
    R.stations.forEach((s, n) => {
      const colour = n ? "#2f855a" : "#2b6cb0", far = 0.12 * size;
      const ray = (a, b) => s.p.map((v, k) => v + far * (0.6 * a * s.r[0][k] + 0.6 * b * s.r[1][k] + s.r[2][k]));
      const rim = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(([a, b]) => ray(a, b));
      rim.forEach((p, k) => { line([s.p, p], colour, 1.5); line([p, rim[(k + 1) % 4]], colour, 1.5); });
      word(s.p, "AB"[n], colour);
    });
  };
  let held = null;
  canvas.onpointerdown = e => { held = [e.clientX, e.clientY]; canvas.setPointerCapture(e.pointerId); };
  canvas.onpointerup = () => held = null;
  canvas.onpointermove = e => {
    if (!held) return;
    turn += (e.clientX - held[0]) / 200;
    lean = Math.max(-1.57, Math.min(1.57, lean + (e.clientY - held[1]) / 200));
    held = [e.clientX, e.clientY];
    draw();
  };
  canvas.onwheel = e => {
    e.preventDefault();
    zoom = Math.max(0.3, Math.min(20, zoom * Math.exp(-e.deltaY / 500)));
    draw();
  };
  draw();
})();
