// What three.min.js holds, as the global THREE: three 0.183.2 (three.LICENSE.txt), what nothing here asks for left out.
//   npm install three@0.183.2 esbuild
//   npx esbuild three.entry.js --bundle --minify --format=iife --global-name=THREE --outfile=three.min.js
export { BufferAttribute, DataTexture, DataUtils, EquirectangularReflectionMapping, HalfFloatType, LinearFilter,
  LinearSRGBColorSpace, Matrix4, MeshBasicMaterial, PerspectiveCamera, RGBAFormat, Scene, ShaderMaterial, Vector3, WebGLRenderer } from "three";
export { OrbitControls } from "three/addons/controls/OrbitControls.js";
export { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
export { HDRLoader } from "three/addons/loaders/HDRLoader.js";
