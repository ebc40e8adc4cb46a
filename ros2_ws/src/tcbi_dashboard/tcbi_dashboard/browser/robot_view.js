// One robot: coloured by the error of its joints, or moving as it is told.
import { Robot, Stage, SCALE, savePicture, scaled } from "tcbi-stage";

export default {
  template: `
    <div class="tcbi-stage"><canvas :aria-label="label"></canvas>
      <div v-if="fault" class="tcbi-stage-fault">{{ fault }}</div>
      <div v-if="top > 0" class="tcbi-scale"><span>{{ low }}</span><i :style="gradient"></i><span>{{ top.toPrecision(2) }}</span> × noise floor</div>
      <button class="tcbi-picture" title="Save the drawing as PNG" @click="picture">PNG</button>
    </div>`,
  props: { skeleton: Object, errors: Object, label: String },
  data: () => ({ fault: "", top: 0, low: 1 }),
  computed: { gradient: () => ({ background: `linear-gradient(to right, ${SCALE.join(",")})` }) },
  async mounted() {
    await new Promise((done) => setTimeout(done, 0));
    try {
      this.stage = new Stage(this.$el.querySelector("canvas"));
      this.robot = new Robot(this.skeleton, { color: "#98a1ab" });
      this.stage.scene.add(this.robot.root);
      if (this.skeleton.floating) this.stage.follow(0, 0, 0.06);
      else this.stage.frame(this.robot.root);
      this.paint();
    } catch (error) {
      this.fault = "This browser cannot draw in 3D (WebGL is off).";
    }
  },
  beforeUnmount() {
    this.robot?.dispose();
    this.stage?.close();
  },
  watch: { errors: { handler() { this.paint(); }, deep: true } },
  methods: {
    paint() {
      const values = Object.values(this.errors ?? {}).filter(Number.isFinite);
      this.top = values.length ? Math.max(1.5, ...values) : 0;
      this.robot?.paint((joint) => {
        const error = this.errors?.[this.skeleton.joints[joint]];
        return Number.isFinite(error) ? scaled((error - 1) / (this.top - 1)) : null;
      });
      this.stage?.ask();
    },
    pose(base, joints) {
      this.robot?.pose(base, 0, joints, 0);
      this.stage?.ask();
    },
    picture() { if (this.stage) savePicture(this.stage.canvas, "robot.png"); },
  },
};
