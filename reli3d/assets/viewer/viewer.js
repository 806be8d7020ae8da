'use strict'
// The page next to mesh.glb.  Everything comes from the JSON in #data: meshes and lights as base64, photographs as data
// URLs with their cameras: c2w by rows (OpenGL axes) and fx, fy, cx, cy in pixels.
const T = THREE
const get = id => document.getElementById(id)
const data = JSON.parse(get('data').textContent)
const stage = get('stage'), photograph = get('photograph')
const bytes = text => Uint8Array.from(atob(text), c => c.charCodeAt(0)).buffer
const inflate = data => new Response(new Blob([data]).stream().pipeThrough(new DecompressionStream('deflate'))).arrayBuffer()
const FINE = 512 // columns of the maps that three.js filters: it makes cubes of a quarter of them

const renderer = new T.WebGLRenderer({ alpha: true, antialias: true })
renderer.setPixelRatio(window.devicePixelRatio)
stage.prepend(renderer.domElement)
const scene = new T.Scene()
const camera = new T.PerspectiveCamera(35, 1, 0.01, 100)
const orbit = new T.OrbitControls(camera, renderer.domElement)
let stop = null // the photograph whose camera is in use, or null
let waiting = false

// Unlit layers: values of the maps, normals in world axes.
const layers = { 'base color': 0, roughness: 1, metallic: 2, normal: 3 }
const VERTEX = `
attribute vec4 tangent;
varying vec2 at;
varying vec3 n, t, b;
void main() {
  at = uv;
  n = normal;
  t = tangent.xyz;
  b = cross(n, t) * tangent.w;
  gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
}`
const FRAGMENT = `
uniform sampler2D color, orm, bump;
uniform int layer;
varying vec2 at;
varying vec3 n, t, b;
void main() {
  if (layer == 0) gl_FragColor = linearToOutputTexel(texture2D(color, at));
  else if (layer == 3) {
    vec3 v = texture2D(bump, at).xyz * 2.0 - 1.0;
    gl_FragColor = vec4(normalize(v.x * normalize(t) + v.y * normalize(b) + v.z * normalize(n)) * 0.5 + 0.5, 1.0);
  } else gl_FragColor = vec4(vec3(layer == 1 ? texture2D(orm, at).g : texture2D(orm, at).b), 1.0);
}`

// Shadows: reli3d/render/transfer.py.  A vertex has the harmonics of the directions that the mesh occludes,
// weighted by the cosine.  Their product with those of the light is the occluded irradiance.
const HARMONICS = `
mat4 harmonics(vec3 d) { // degree 0 is the first value, 1 the next three, 2 the next five, 3 the last seven
  float x = d.z, y = d.x, z = d.y, xx = x * x, yy = y * y, zz = z * z;
  return mat4(0.2820948, 0.4886025 * y, 0.4886025 * z, 0.4886025 * x,
    1.0925484 * x * y, 1.0925484 * y * z, 0.3153916 * (3.0 * zz - 1.0), 1.0925484 * x * z,
    0.5462742 * (xx - yy), 0.5900436 * y * (3.0 * xx - yy), 2.8906114 * x * y * z, 0.4570458 * y * (5.0 * zz - 1.0),
    0.3731763 * z * (5.0 * zz - 3.0), 0.4570458 * x * (5.0 * zz - 1.0), 1.4453057 * z * (xx - yy),
    0.5900436 * x * (xx - 3.0 * yy));
}
mat4 bands(mat4 v, float k0, float k1, float k2, float k3) {
  return matrixCompMult(v, mat4(k0, k1, k1, k1, k2, k2, k2, k2, k2, k3, k3, k3, k3, k3, k3, k3));
}
mat4 cosine(mat4 v) { return bands(v, 3.1415927, 2.0943951, 0.7853982, 0.0); }
float product(mat4 a, mat4 b) { return dot(a[0], b[0]) + dot(a[1], b[1]) + dot(a[2], b[2]) + dot(a[3], b[3]); }
`
const SHADOW_VERTEX = `
attribute mat4 blocked;
uniform mat4 lightHarmonics[3];
uniform float largest;
varying mat4 hidden;
varying vec3 open, up;
` + HARMONICS
const SHADOW_AT_VERTEX = `
hidden = largest * blocked;
up = normal;
mat4 whole = cosine(harmonics(normal));
for (int i = 0; i < 3; i++)
  open[i] = clamp(1.0 - product(hidden, lightHarmonics[i]) / max(product(whole, lightHarmonics[i]), 1e-6), 0.0, 1.0);
`
// Occlusion of the specular lobe: of a spherical Gaussian about the mirror direction as wide as GGX's (Wang et al. 2009).
// The part of the lobe below the tangent plane is reflected, so that an unoccluded point loses no light.
const SHADOW_AT_FRAGMENT = `
iblIrradiance *= open;
vec3 facing = normalize(up), mirrored = reflect(-geometryViewDir, geometryNormal);
mirrored = inverseTransformDirection(normalize(mix(mirrored, geometryNormal, pow4(material.roughness))), viewMatrix);
float wide = pow4(material.roughness);
mat4 lobe = harmonics(mirrored) + harmonics(reflect(mirrored, facing));
lobe = bands(lobe, 1.0, exp(-2.0 * wide), exp(-6.0 * wide), exp(-12.0 * wide));
radiance *= clamp(1.0 - product(hidden, lobe) / product(cosine(lobe), harmonics(facing)), 0.0, 1.0);
`

// MeshStandardMaterial with image-based light occluded by the mesh; all materials use the same uniforms.
function shadowed(material, uniforms) {
  material.onBeforeCompile = shader => {
    Object.assign(shader.uniforms, uniforms)
    const after = (text, chunk, code) => text.replace(`#include <${chunk}>`, `#include <${chunk}>\n${code}`)
    shader.vertexShader = after(after(shader.vertexShader, 'common', SHADOW_VERTEX), 'begin_vertex', SHADOW_AT_VERTEX)
    shader.fragmentShader = after(after(shader.fragmentShader, 'common',
      'varying mat4 hidden;\nvarying vec3 open, up;\n' + HARMONICS), 'lights_fragment_maps', SHADOW_AT_FRAGMENT)
  }
}

// The harmonics of a light turned by an angle about +Y, their polar axis: those of order m and -m are a pair.
function turned(harmonics, angle) {
  const out = [...harmonics]
  for (let l = 1; l < 4; l++) for (let m = 1; m <= l; m++) {
    const i = l * l + l + m, j = l * l + l - m, c = Math.cos(m * angle), s = Math.sin(m * angle)
    out[i] = c * harmonics[i] - s * harmonics[j]
    out[j] = s * harmonics[i] + c * harmonics[j]
  }
  return out
}

function draw() {
  renderer.render(scene, camera)
}

function later() {
  if (waiting) return
  waiting = true
  requestAnimationFrame(() => { waiting = false; draw() })
}

// A map of more columns, bilinear between texel centers as in reli3d's renderer; half floats in and out.
function finer({ width, height, data: half }) {
  const scale = Math.max(1, Math.round(FINE / width)), w = width * scale, h = height * scale
  const linear = Float32Array.from(half, T.DataUtils.fromHalfFloat), out = new Uint16Array(4 * w * h)
  for (let y = 0; y < h; y++) for (let x = 0; x < w; x++) {
    const u = (x + 0.5) / scale - 0.5, v = Math.min(Math.max((y + 0.5) / scale - 0.5, 0), height - 1)
    const i = Math.floor(u), j = Math.floor(v), k = Math.min(j + 1, height - 1), p = u - i, q = v - j
    const a = (i + width) % width, b = (i + 1) % width
    for (let c = 0; c < 4; c++) {
      const value = (column, row) => linear[4 * (row * width + column) + c]
      const top = value(a, j) * (1 - p) + value(b, j) * p, low = value(a, k) * (1 - p) + value(b, k) * p
      out[4 * (y * w + x) + c] = T.DataUtils.toHalfFloat(top * (1 - q) + low * q)
    }
  }
  const texture = new T.DataTexture(out, w, h, T.RGBAFormat, T.HalfFloatType)
  texture.mapping = T.EquirectangularReflectionMapping
  texture.colorSpace = T.LinearSRGBColorSpace
  texture.minFilter = texture.magFilter = T.LinearFilter
  texture.flipY = true // HDRLoader's row order
  texture.needsUpdate = true
  return texture
}

async function load() {
  const loader = new T.GLTFLoader(), parts = []
  const lightHarmonics = { value: [0, 1, 2].map(() => new T.Matrix4()) }
  for (const { name, glb, blocked, largest } of data.meshes) {
    const { scene: root } = await loader.parseAsync(bytes(glb), '')
    const hidden = new Int8Array(await inflate(bytes(blocked)))
    root.traverse(mesh => {
      if (!mesh.isMesh) return
      const lit = mesh.material, shown = { lit }
      mesh.geometry.setAttribute('blocked', new T.BufferAttribute(hidden, 16, true))
      shadowed(lit, { lightHarmonics, largest: { value: largest } })
      const maps = { color: { value: lit.map }, orm: { value: lit.roughnessMap }, bump: { value: lit.normalMap } }
      for (const [layer, value] of Object.entries(layers)) shown[layer] = new T.ShaderMaterial(
        { vertexShader: VERTEX, fragmentShader: FRAGMENT, uniforms: { ...maps, layer: { value } } })
      shown.wireframe = new T.MeshBasicMaterial({ color: 0x333333, wireframe: true })
      parts.push({ name, mesh, shown })
    })
    scene.add(root)
    get('mesh').add(new Option(name))
  }
  get('mesh').parentElement.hidden = data.meshes.length < 2
  const lights = new Map(data.lights.map(({ name, hdr, harmonics }) =>
    [name, { map: finer(new T.HDRLoader().parse(bytes(hdr))), harmonics }]))
  for (const name of lights.keys()) get('light').add(new Option(name))
  renderer.setClearColor(0, 0)

  function change() {
    for (const { name, mesh, shown } of parts) {
      mesh.visible = name === get('mesh').value
      mesh.material = shown[get('layer').value]
    }
    const { map, harmonics } = lights.get(get('light').value), angle = get('turn').value * Math.PI / 180
    for (const [channel, matrix] of lightHarmonics.value.entries()) matrix.fromArray(turned(harmonics[channel], angle))
    scene.environment = map
    scene.background = get('behind').checked ? map : null
    scene.environmentRotation.set(0, angle, 0)
    scene.backgroundRotation.set(0, angle, 0)
    scene.environmentIntensity = scene.backgroundIntensity = 2 ** get('stopsof').value
    later()
  }
  for (const id of ['mesh', 'layer', 'light', 'turn', 'stopsof', 'behind']) get(id).addEventListener('input', change)
  change()
  return parts
}

// Centers the photograph's camera in the window, as large as fits; the margins show the scene around it.
function place() {
  const width = stage.clientWidth, height = stage.clientHeight
  renderer.setSize(width, height)
  camera.aspect = width / height
  camera.updateProjectionMatrix()
  photograph.hidden = stop === null
  if (stop !== null) {
    const view = data.views[stop], [fx, fy, cx, cy] = view.intrinsics
    const scale = Math.min(width / view.width, height / view.height)
    const left = (width - scale * view.width) / 2, top = (height - scale * view.height) / 2
    Object.assign(photograph.style, { left: `${left}px`, top: `${top}px`, width: `${scale * view.width}px`,
      height: `${scale * view.height}px` })
    const x = left + scale * cx, y = top + scale * cy // the principal point in the window
    const near = camera.near, a = near / (scale * fx), b = near / (scale * fy)
    camera.projectionMatrix.makePerspective(-x * a, (width - x) * a, y * b, (y - height) * b, near, camera.far)
    camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert()
  }
  later()
}

function blend() {
  photograph.style.opacity = stop === null ? 0 : get('blend').value
  renderer.domElement.style.opacity = 1 - photograph.style.opacity
}

function take(index) {
  stop = index
  const view = data.views[index], m = new T.Matrix4().set(...view.c2w.flat())
  m.decompose(camera.position, camera.quaternion, new T.Vector3())
  const ahead = new T.Vector3(0, 0, -1).applyQuaternion(camera.quaternion)
  const depth = new T.Vector3(...data.middle).sub(camera.position).dot(ahead)
  orbit.target.copy(camera.position).addScaledVector(ahead, Math.max(depth, 0.1 * data.radius))
  camera.fov = 360 / Math.PI * Math.atan(0.5 * view.height / view.intrinsics[1])
  photograph.src = view.image
  for (const [i, button] of [...get('stops').children].entries()) button.ariaPressed = String(i === index)
  place()
  blend()
}

function leave() {
  if (stop === null) return
  stop = null
  for (const button of get('stops').children) button.ariaPressed = 'false'
  place()
  blend()
}

// A PNG of the window's view, as a data URL.
function imageURL() {
  draw()
  return renderer.domElement.toDataURL('image/png')
}

async function start() {
  await load()
  const distance = data.views.length ? Math.max(...data.views.map(v => new T.Vector3(v.c2w[0][3], v.c2w[1][3],
    v.c2w[2][3]).distanceTo(new T.Vector3(...data.middle)))) : 4 * data.radius
  camera.near = data.radius / 50
  camera.far = 20 * Math.max(distance, data.radius)
  orbit.maxDistance = 8 * Math.max(distance, data.radius)
  orbit.addEventListener('start', leave)
  orbit.addEventListener('change', () => { if (stop === null) later() })
  for (const [index, view] of data.views.entries()) {
    const button = document.createElement('button'), image = new Image()
    Object.assign(button, { type: 'button', title: view.name, onclick: () => take(index) })
    Object.assign(image, { src: view.image, alt: view.name })
    button.append(image)
    get('stops').append(button)
  }
  get('blend').addEventListener('input', blend)
  get('save').onclick = () => Object.assign(document.createElement('a'), { href: imageURL(), download: `${data.name}.png` }).click()
  addEventListener('resize', place)
  if (data.views.length) take(0)
  else {
    orbit.target.set(...data.middle)
    camera.position.set(...data.middle).add(new T.Vector3(1, 0.7, 2).setLength(4 * data.radius))
    camera.lookAt(orbit.target)
    place()
  }
  draw()
}
window.ready = start()
window.ready.then(() => { document.body.dataset.ready = 'yes' })
