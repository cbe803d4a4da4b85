// A picture of counts: zoomed by the wheel or + and -, moved by dragging or the arrow keys, with marks over it.
(() => {
  const { h, ref, watch, onMounted } = Vue;

  const LfImage = {
    props: { image: Object, low: Number, high: Number, marks: Array, name: String, smooth: Boolean, region: Array },
    emits: ['point'],
    setup(props, { emit }) {
      const box = ref(null), canvas = ref(null), readout = ref('');
      let data = null, bitmap = null, view = null, drag = null;

      function load() {
        const wanted = props.image && Vue.toRaw(props.image);
        if (!wanted) { data = bitmap = null; draw(); return; }
        if (!data || data.rows !== wanted.rows || data.columns !== wanted.columns) view = null;
        data = { ...wanted, values: new Float32Array(wanted.values.slice().buffer) };
        paint();
        look(props.region);
      }

      function paint() {
        if (!data) return;
        const { values, rows, columns, channels } = data, count = rows * columns;
        const pixels = new Uint8ClampedArray(4 * count).fill(255), low = props.low, scale = 255 / Math.max(props.high - low, 1e-9);
        for (let i = 0; i < count; i++) for (let c = 0; c < 3; c++) pixels[4 * i + c] = (values[channels === 1 ? i : 3 * i + c] - low) * scale;
        bitmap = Object.assign(document.createElement('canvas'), { width: columns, height: rows });
        bitmap.getContext('2d').putImageData(new ImageData(pixels, columns, rows), 0, 0);
        draw();
      }

      function aim(left, top, right, bottom, share) {  // fills this share of the canvas
        const { width, height } = canvas.value, scale = share * Math.min(width / (right - left), height / (bottom - top));
        view = { scale, x: (width - scale * (left + right + 1)) / 2, y: (height - scale * (top + bottom + 1)) / 2 };
      }

      function look(region) {
        if (!data || !region?.length) return;
        aim(region[0] - 10, region[1] - 10, region[2] + 10, region[3] + 10, 0.5);
        draw();
      }

      function draw() {
        const sheet = canvas.value, frame = box.value;
        if (!sheet || !frame) return;
        const ratio = window.devicePixelRatio || 1, [width, height] = [frame.clientWidth, frame.clientHeight].map((px) => Math.round(px * ratio));
        if (!width || !height) return;
        if (sheet.width !== width || sheet.height !== height) { sheet.width = width; sheet.height = height; view = null; }
        const context = sheet.getContext('2d');
        context.clearRect(0, 0, width, height);
        if (!bitmap) return;
        if (!view) aim(-0.5, -0.5, data.columns - 0.5, data.rows - 0.5, 0.98);
        context.imageSmoothingEnabled = !!props.smooth || view.scale < 1;
        context.drawImage(bitmap, view.x, view.y, data.columns * view.scale, data.rows * view.scale);
        for (const mark of props.marks || []) drawMark(context, mark);
        if (props.region?.length) {
          const [x, y] = at(props.region[0] - 0.5, props.region[1] - 0.5), [u, v] = at(props.region[2] + 0.5, props.region[3] + 0.5);
          Object.assign(context, { lineWidth: 2, strokeStyle: '#ff922b' });
          context.strokeRect(x, y, u - x, v - y);
        }
        sheet.dataset.drawn = Number(sheet.dataset.drawn || 0) + 1;
      }

      const at = (column, row) => [view.x + (column + 0.5) * view.scale, view.y + (row + 0.5) * view.scale];

      function drawMark(context, mark) {
        Object.assign(context, { strokeStyle: mark.colour, fillStyle: mark.colour, lineWidth: 1.5 });
        const size = mark.radius ? mark.radius * view.scale : 4, places = mark.places;
        if (mark.kind === 'arrows') places.forEach(([a, b, c, d]) => arrow(context, ...at(a, b), ...at(c, d)));
        else places.forEach(([column, row], number) => {
          const [x, y] = at(column, row);
          if (x < -20 || y < -20 || x > canvas.value.width + 20 || y > canvas.value.height + 20) return;
          context.beginPath();
          context.arc(x, y, Math.max(size, 1), 0, 7);
          if (mark.kind === 'points') context.fill(); else context.stroke();
          if (mark.names) {
            context.font = mark.kind === 'points' ? 'bold 15px sans-serif' : '12px sans-serif';
            Object.assign(context, { lineWidth: 3, strokeStyle: 'rgba(14, 16, 19, 0.85)' });  // read on any picture
            context.strokeText(mark.names[number], x + size + 2, y - size);
            context.fillText(mark.names[number], x + size + 2, y - size);
            Object.assign(context, { lineWidth: 1.5, strokeStyle: mark.colour });
          }
        });
      }

      function arrow(context, x, y, u, v) {
        const turn = Math.atan2(v - y, u - x), head = Math.min(9, Math.hypot(u - x, v - y) / 2);
        context.beginPath();
        context.moveTo(x, y);
        for (const side of [turn - 0.5, turn + 0.5]) {
          context.lineTo(u, v); context.lineTo(u - head * Math.cos(side), v - head * Math.sin(side)); context.moveTo(u, v);
        }
        context.stroke();
      }

      function place(event) {
        const rect = canvas.value.getBoundingClientRect(), ratio = canvas.value.width / rect.width;
        const x = (event.clientX - rect.left) * ratio, y = (event.clientY - rect.top) * ratio;
        return { x, y, column: (x - view.x) / view.scale - 0.5, row: (y - view.y) / view.scale - 0.5 };
      }

      function zoom(x, y, factor) {
        view = { scale: view.scale * factor, x: x - (x - view.x) * factor, y: y - (y - view.y) * factor };
        draw();
      }

      let waiting = null;
      function point(spot) {
        const column = Math.round(spot.column), row = Math.round(spot.row), i = row * data.columns + column;
        if (column < 0 || row < 0 || column >= data.columns || row >= data.rows) { readout.value = ''; return; }
        const value = data.channels === 1 ? data.values[i].toPrecision(5) * 1 : '';
        readout.value = `column ${column}, row ${row}: ${value}`;
        if (!waiting) setTimeout(() => { const [c, r] = waiting; waiting = null; emit('point', [c, r]); }, 40);
        waiting = [spot.column, spot.row];
      }

      function move(event) {
        if (!view || !data) return;
        const spot = place(event);
        if (!drag) { point(spot); return; }
        view.x += spot.x - drag.x; view.y += spot.y - drag.y; drag = spot;
        draw();
      }

      function key(event) {
        if (!view) return;
        const { width, height } = canvas.value, step = 60;
        const shift = { ArrowLeft: [step, 0], ArrowRight: [-step, 0], ArrowUp: [0, step], ArrowDown: [0, -step] }[event.key];
        if (shift) { view.x += shift[0]; view.y += shift[1]; draw(); }
        else if (event.key === '+' || event.key === '-') zoom(width / 2, height / 2, event.key === '+' ? 1.4 : 1 / 1.4);
        else if (event.key === '0') { view = null; draw(); }
        else return;
        event.preventDefault();
        point({ column: (width / 2 - view.x) / view.scale, row: (height / 2 - view.y) / view.scale });
      }

      onMounted(() => { new ResizeObserver(draw).observe(box.value); load(); });
      watch(() => props.image, load);
      watch(() => [props.low, props.high], paint);
      watch(() => props.marks, draw);
      watch(() => props.region, look);
      return () => h('div', { ref: box, class: 'lf-image' }, [
        h('canvas', {
          ref: canvas, tabindex: 0, role: 'img', 'aria-label': props.name,
          onPointermove: move,
          onPointerdown: (event) => { if (view) { drag = place(event); event.target.setPointerCapture(event.pointerId); } },
          onPointerup: () => { drag = null; },
          onWheel: (event) => { event.preventDefault(); if (view) { const s = place(event); zoom(s.x, s.y, event.deltaY < 0 ? 1.25 : 0.8); } },
          onDblclick: () => { view = null; draw(); },
          onKeydown: key,
        }),
        h('div', { class: 'lf-name' }, props.name),
        h('div', { class: 'lf-readout' }, readout.value),
      ]);
    },
  };

  window.lfpivStudio = { install(app) { app.component('lf-image', LfImage); } };
})();
