// The loops of a gradient step on an Nvidia GPU. Matrices are row-major.

// Activations in the order of the enum `Activation`; another number is the identity.
enum { MISH, RELU, SILU, TANH, GELU };

// y = f(z + bias), and where slope is not null also f'(z + bias), of members × rows × width numbers; each member has a bias.
extern "C" __global__ void activate(const float *z, const float *bias, float *y, float *slope, unsigned count,
                                    unsigned member, unsigned width, unsigned activation) {
  for (unsigned i = blockIdx.x * blockDim.x + threadIdx.x; i < count; i += gridDim.x * blockDim.x) {
    float x = z[i] + bias[i / member * width + i % width], value = x, derivative = 1.0f;
    if (activation == MISH) {
      // Mish by one exponential: x·n/(n + 2) with n = e^x (e^x + 2). From 20 on it is x, to the last bit.
      float e = expf(fminf(x, 20.0f)), n = e * (e + 2.0f), d = n + 2.0f;
      value = x * (n / d);
      derivative = n / d + x * (4.0f * e * (e + 1.0f) / (d * d));
    } else if (activation == RELU) {
      // The product keeps a NaN.
      value = x > 0.0f ? x : 0.0f * x;
      derivative = x > 0.0f ? 1.0f : 0.0f;
    } else if (activation == SILU) {
      float s = 1.0f / (1.0f + expf(-x));
      value = x * s;
      derivative = s * (1.0f + x * (1.0f - s));
    } else if (activation == TANH) {
      value = tanhf(x);
      derivative = 1.0f - value * value;
    } else if (activation == GELU) {
      // x·s with s = σ(2u), where u is what GELU's tanh is of.
      float square = x * x, s = 1.0f / (1.0f + expf(-1.5957692f * x * (1.0f + 0.044715f * square)));
      value = x * s;
      derivative = s >= 1.0f || s <= 0.0f ? s : s + value * (1.0f - s) * 1.5957692f * (1.0f + 0.134145f * square);
    }
    y[i] = value;
    if (slope) slope[i] = derivative;
  }
}

// One reverse step of a diffusion: x ← clamp(from_clean·clean + from_noisy·x + noise·z), where clean is the predicted x_0.
extern "C" __global__ void reverse_step(const float *x, const float *epsilon, const float *z, float *out, unsigned count,
                                        float deviation, float scale, float clean_bound, float from_clean,
                                        float from_noisy, float noise, float bound) {
  unsigned i = blockIdx.x * blockDim.x + threadIdx.x;
  if (i >= count) return;
  float clean = (x[i] - deviation * epsilon[i]) * scale;
  // Comparisons that keep a NaN.
  clean = clean > clean_bound ? clean_bound : clean < -clean_bound ? -clean_bound : clean;
  float next = from_clean * clean + from_noisy * x[i] + (noise == 0.0f ? 0.0f : noise * z[i]);
  out[i] = next > bound ? bound : next < -bound ? -bound : next;
}

// The sum over a block of 256 threads, in a fixed order; every thread gets it.
static __device__ float block_sum(float x) {
  __shared__ float sums[256];
  sums[threadIdx.x] = x;
  __syncthreads();
  for (unsigned half = 128; half > 0; half /= 2) {
    if (threadIdx.x < half) sums[threadIdx.x] += sums[threadIdx.x + half];
    __syncthreads();
  }
  return sums[0];
}

// partial[256]: the sums of squares of 256 shares of x.
extern "C" __global__ void squares(const float *x, float *partial, unsigned count) {
  float sum = 0.0f;
  for (unsigned i = blockIdx.x * 256 + threadIdx.x; i < count; i += gridDim.x * 256) sum += x[i] * x[i];
  sum = block_sum(sum);
  if (threadIdx.x == 0) partial[blockIdx.x] = sum;
}

// Adam's step, along a gradient that is first scaled down to the norm `clip` if it is longer. partial is what `squares` gave;
// norm becomes the gradient's norm; rates are the step's rate, weight decay and correction of the second moment.
extern "C" __global__ void adam(float *p, float *m, float *v, const float *gradient, const float *partial, float *norm,
                                unsigned count, float clip, const float *rates) {
  float length = sqrtf(block_sum(partial[threadIdx.x]));
  float scale = length > clip ? clip / length : 1.0f;
  unsigned i = blockIdx.x * 256 + threadIdx.x;
  if (i == 0) *norm = length;
  if (i >= count) return;
  float g = gradient[i] * scale;
  float first = 0.9f * m[i] + 0.1f * g, second = 0.999f * v[i] + 0.001f * g * g;
  m[i] = first;
  v[i] = second;
  p[i] -= rates[0] * first / (sqrtf(second) * rates[2] + 1e-8f) + rates[1] * p[i];
}

// target += rate·(online - target).
extern "C" __global__ void ema(float *target, const float *online, unsigned count, float rate) {
  unsigned i = blockIdx.x * blockDim.x + threadIdx.x;
  if (i < count) target[i] += rate * (online[i] - target[i]);
}
