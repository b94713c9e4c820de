/**
 * The two halves of the WebGL2 program that has MuJoCo's look.
 *
 * MuJoCo draws with fixed-function OpenGL: light is worked out at each corner (ambient, diffuse,
 * specular, for every light), clamped, interpolated over the triangle, and multiplied by the
 * texture. There is no gamma. The formulas are those of the OpenGL 2.1 specification, 2.14.1, for
 * lights that are far away and an eye that is near.
 *
 * All shapes are in one buffer; a corner knows the number of its shape, and two small textures hold
 * the shapes' poses and materials. So a picture takes one call for each change of texture (hammer:
 * 20) and not one for each shape.
 */

export const MOST_LIGHTS = 8;
/** Texels for each shape: a 3 x 4 matrix, row by row. */
export const POSE_TEXELS = 3;
/** Colour; emission, specular, shininess; texture's scale; texture's shift. */
export const MATERIAL_TEXELS = 4;

export const VERTEX = `#version 300 es
precision highp float;
precision highp int;
layout(location = 0) in vec3 position;
layout(location = 1) in vec3 normal;
layout(location = 2) in float shape;

struct Light {
  vec3 towards;  // To the light, unit length.
  vec3 ambient;
  vec3 diffuse;
  vec3 specular;
};

uniform highp sampler2D poses;  // By default they would have a few bits only.
uniform highp sampler2D materials;
uniform mat4 projection;  // From the world to the picture.
uniform vec3 eye;
uniform vec3 ahead;
uniform float sky;  // Metres to the sky's cylinder; 0: these shapes are no sky.
uniform float opacity;
uniform int lights;
uniform Light light[${MOST_LIGHTS}];

out vec4 colour;
out vec3 place;  // On the texture.
out float away;  // Metres along the camera's axis.

void main() {
  int row = int(shape);
  vec4 scale = texelFetch(materials, ivec2(2, row), 0);
  place = position * scale.xyz + texelFetch(materials, ivec2(3, row), 0).xyz;
  if (sky > 0.0) {
    // The sky stands about the eye and is never lit; its texture's y axis is the world's z.
    vec3 world = eye + sky * position;
    place = vec3(position.x, position.z, -position.y);
    colour = vec4(1.0);
    away = dot(world - eye, ahead);
    gl_Position = projection * vec4(world, 1.0);
    return;
  }
  vec4 x = texelFetch(poses, ivec2(0, row), 0);
  vec4 y = texelFetch(poses, ivec2(1, row), 0);
  vec4 z = texelFetch(poses, ivec2(2, row), 0);
  vec4 corner = vec4(position, 1.0);
  vec3 world = vec3(dot(x, corner), dot(y, corner), dot(z, corner));
  vec3 facing = normalize(vec3(dot(x.xyz, normal), dot(y.xyz, normal), dot(z.xyz, normal)));
  vec4 rgba = texelFetch(materials, ivec2(0, row), 0);
  vec4 surface = texelFetch(materials, ivec2(1, row), 0);
  vec3 towardsEye = normalize(eye - world);
  vec3 sum = surface.x * rgba.rgb;
  for (int i = 0; i < lights; i++) {
    float lit = max(dot(facing, light[i].towards), 0.0);
    sum += rgba.rgb * (light[i].ambient + lit * light[i].diffuse);
    if (lit > 0.0) {
      float shine = max(dot(facing, normalize(light[i].towards + towardsEye)), 0.0);
      sum += surface.y * light[i].specular * (surface.z > 0.0 ? pow(shine, surface.z) : 1.0);
    }
  }
  colour = clamp(vec4(sum, rgba.a * opacity), 0.0, 1.0);
  away = dot(world - eye, ahead);
  gl_Position = projection * vec4(world, 1.0);
}
`;

export const FRAGMENT = `#version 300 es
precision highp float;
uniform highp sampler2D flat2d;
uniform highp samplerCube cube;
uniform int texturing;  // 0: none, 1: a picture, 2: a cube.
uniform vec2 depthRange;  // Metres that are 0 and 255 in the fourth number; equal: it is opacity.

in vec4 colour;
in vec3 place;
in float away;
out vec4 result;

void main() {
  vec4 texel = vec4(1.0);
  if (texturing == 1) texel = texture(flat2d, place.xy);
  if (texturing == 2) texel = texture(cube, place);
  result = colour * texel;
  if (depthRange.y > depthRange.x) {
    result.a = clamp((away - depthRange.x) / (depthRange.y - depthRange.x), 0.0, 1.0);
  }
}
`;
