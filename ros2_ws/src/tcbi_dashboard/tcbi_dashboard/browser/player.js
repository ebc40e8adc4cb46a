// Robot and prediction side by side in time: one slider for the drawing and the signals beneath. All of it runs here.
import { echarts } from "nicegui-echart";
import { Robot, Stage, load, savePicture } from "tcbi-stage";

const MEASURED = "#d55e00", PREDICTED = "#0072b2", ALSO = "#009e73", INK = "#7b838c";
const HEIGHT = 168;

export default {
  template: `
    <div class="tcbi-player">
      <div class="tcbi-stage"><canvas aria-label="The robot and its prediction in 3D"></canvas>
        <div v-if="fault" class="tcbi-stage-fault">{{ fault }}</div>
        <ul class="tcbi-legend"><li><i style="background:${MEASURED}"></i>measured</li>
          <li><i style="background:${PREDICTED}"></i>{{ model }}</li>
          <li v-if="also"><i style="background:${ALSO}"></i>{{ also }}: in the signals below</li></ul>
        <div class="tcbi-stage-note">{{ note }}</div>
        <button class="tcbi-picture" title="Save the drawing as PNG" @click="picture">PNG</button>
      </div>
      <div class="tcbi-transport">
        <button @click="toggle" :aria-label="playing ? 'pause' : 'play'">{{ playing ? '❚❚' : '▶' }}</button>
        <input type="range" min="0" :max="length - 1" step="1" :value="index" @input="slide" aria-label="time">
        <output>{{ now.toFixed(2) }} / {{ end.toFixed(2) }} s</output>
      </div>
      <div class="tcbi-signals"><div ref="chart"></div><b v-for="line in lines" :style="line"></b></div>
    </div>`,
  props: { skeleton: Object, source: String, model: String, also: String, channels: Array, signals: Array, start: Number },
  data: () => ({ index: 0, length: 2, now: 0, end: 0, playing: false, fault: "", note: "", lines: [] }),
  async mounted() {
    await new Promise((done) => setTimeout(done, 0));
    try {
      this.stage = new Stage(this.$el.querySelector("canvas"));
      this.robot = new Robot(this.skeleton, { color: MEASURED });
      this.ghost = new Robot(this.skeleton, { color: PREDICTED, opacity: 0.45 });
      this.stage.scene.add(this.robot.root, this.ghost.root);
      if (!this.skeleton.floating) this.stage.frame(this.robot.root);
    } catch (error) {
      this.fault = "This browser cannot draw in 3D (WebGL is off). The signals below show the same motion.";
    }
    this.$el.frames = () => this.stage?.frames ?? 0;
    this.chart = echarts.init(this.$refs.chart);
    this.chart.getZr().on("click", (e) => this.clicked(e));
    this.observer = new ResizeObserver(() => { this.chart.resize(); this.mark(); });
    this.observer.observe(this.$refs.chart);
    await this.fetch();
  },
  beforeUnmount() {
    this.gone = true;
    cancelAnimationFrame(this.clock);
    this.observer?.disconnect();
    this.chart?.dispose();
    this.robot?.dispose();
    this.ghost?.dispose();
    this.stage?.close();
  },
  watch: {
    source() { this.fetch(); },
    signals() { this.draw(); },
    start(value) { this.jump(value); },
  },
  methods: {
    async fetch() {
      if (!this.source) return;
      const source = this.source;
      try {
        const { header, arrays } = await load(source);
        if (this.gone || source !== this.source) return;
        Object.assign(this, { header, arrays, width: this.channels.length, fault: "" });
      } catch (error) {
        this.fault = `This rollout cannot be shown: ${error.message}.`;
        return;
      }
      this.length = this.arrays.time.length;
      this.end = this.arrays.time[this.length - 1];
      this.note = !this.skeleton.floating || this.header.tracked ? "" : "no tracker: both stand in place";
      this.stage?.setGround(this.header.ground, this.header.blocks);
      this.draw();
      this.jump(this.start ?? 0);
    },
    draw() {
      if (!this.arrays) return;
      const shown = this.signals.filter((i) => i < this.width);
      this.$refs.chart.style.height = `${Math.max(1, shown.length) * HEIGHT}px`;
      this.chart.resize();
      const { time } = this.arrays;
      const column = (name, i) => Array.from(time, (t, k) => [t, this.arrays[name][k * this.width + i]]);
      const series = [];
      shown.forEach((i, g) => {
        const own = { xAxisIndex: g, yAxisIndex: g, showSymbol: false, animation: false };
        const line = (name, values, color, type) => ({ ...own, name, type: "line", data: values, lineStyle: { color, width: 1.6, type }, itemStyle: { color } });
        const low = column("low", i), high = column("high", i);
        const rim = [...low, ...high.reverse()].filter(([, v]) => Number.isFinite(v));
        const renderItem = (_, api) => ({ type: "polygon", shape: { points: rim.map((p) => api.coord(p)) }, style: { fill: PREDICTED, opacity: 0.28 }, silent: true });
        series.push({ type: "custom", name: "90 % band", xAxisIndex: g, yAxisIndex: g, renderItem, clip: true, silent: true, animation: false, data: [0], tooltip: { show: false } });
        series.push({ ...own, type: "line", data: rim, lineStyle: { opacity: 0 }, symbol: "none", silent: true, tooltip: { show: false } });
        series.push(line(this.model, column("predicted", i), PREDICTED, [5, 3]));
        if (this.arrays.predicted_also) series.push(line(this.also, column("predicted_also", i), ALSO, [8, 3, 2, 3]));
        series.push(line("measured", column("measured", i), MEASURED, "solid"));
      });
      const axis = { axisLine: { lineStyle: { color: INK } }, axisLabel: { color: INK, fontSize: 13 }, nameTextStyle: { color: INK, fontSize: 13 }, splitLine: { lineStyle: { color: INK, opacity: 0.15 } } };
      this.chart.setOption({
        animation: false,
        textStyle: { fontFamily: "system-ui, sans-serif" },
        tooltip: { trigger: "axis", valueFormatter: (v) => (Number.isFinite(v) ? Number(v).toPrecision(3) : "–"), order: "seriesAsc" },
        axisPointer: { link: [{ xAxisIndex: "all" }] },
        grid: shown.map((_, g) => ({ left: 58, right: 16, top: g * HEIGHT + 26, height: HEIGHT - 66 })),
        xAxis: shown.map((_, g) => ({ ...axis, gridIndex: g, type: "value", min: 0, max: Number(this.end.toFixed(3)), name: "time / s", nameLocation: "middle", nameGap: 22, splitLine: { show: false } })),
        yAxis: shown.map((i, g) => ({ ...axis, gridIndex: g, type: "value", scale: true, name: `${this.channels[i].name} / ${this.channels[i].unit}`, nameTextStyle: { color: INK, align: "left", fontSize: 13 }, splitNumber: 3 })),
        series,
      }, { notMerge: true });
      this.mark();
    },
    mark() {
      if (!this.arrays) return;
      const shown = this.signals.filter((i) => i < this.width);
      this.lines = shown.map((_, g) => {
        const x = this.chart.convertToPixel({ xAxisIndex: g }, this.now);
        return { left: `${x}px`, top: `${g * HEIGHT + 26}px`, height: `${HEIGHT - 66}px` };
      });
    },
    at(index) {
      if (!this.arrays) return;
      this.index = Math.max(0, Math.min(this.length - 1, index));
      this.now = this.arrays.time[this.index];
      const { joints_measured, joints_predicted, base_measured, base_predicted } = this.arrays;
      const joints = this.skeleton.joints.length;
      this.robot?.pose(base_measured, 7 * this.index, joints_measured, joints * this.index);
      this.ghost?.pose(base_predicted, 7 * this.index, joints_predicted, joints * this.index);
      const [x, y, z] = base_measured.slice(7 * this.index, 7 * this.index + 3);
      if (this.skeleton.floating) this.stage?.follow(x, y, z - 0.03);
      this.stage?.ask();
      this.mark();
    },
    slide(event) { this.at(Number(event.target.value)); },
    jump(time) {
      if (!this.arrays) return;
      const found = this.arrays.time.findIndex((t) => t >= time);
      this.at(found < 0 ? this.length - 1 : found);
    },
    reveal() { this.$el.scrollIntoView({ block: "start" }); },
    clicked(event) {
      const shown = this.signals.length;
      const g = Math.min(shown - 1, Math.floor(event.offsetY / HEIGHT));
      const t = this.chart.convertFromPixel({ xAxisIndex: g }, event.offsetX);
      if (Number.isFinite(t)) this.jump(Math.max(0, t));
    },
    toggle() {
      this.playing = !this.playing;
      if (!this.playing) return cancelAnimationFrame(this.clock);
      if (this.index >= this.length - 1) this.at(0);
      const began = performance.now() - 1000 * this.now;
      const step = () => {
        if (this.gone || !this.playing) return;
        this.jump((performance.now() - began) / 1000);
        if (this.index >= this.length - 1) this.playing = false;
        else this.clock = requestAnimationFrame(step);
      };
      this.clock = requestAnimationFrame(step);
    },
    picture() {
      const chart = new Image();
      chart.onload = () => {
        const canvas = document.createElement("canvas");
        const drawing = this.stage?.canvas;
        const width = chart.width, top = drawing ? Math.round((drawing.height / drawing.width) * width) : 0;
        Object.assign(canvas, { width, height: top + chart.height });
        const context = canvas.getContext("2d");
        context.fillStyle = getComputedStyle(document.body).backgroundColor;
        context.fillRect(0, 0, width, canvas.height);
        if (drawing) context.drawImage(drawing, 0, 0, width, top);
        context.drawImage(chart, 0, top);
        savePicture(canvas, `${this.header?.rollout ?? "rollout"}.png`);
      };
      chart.src = this.chart.getDataURL({ pixelRatio: 2 });
    },
  },
};
