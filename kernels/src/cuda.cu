// The loops of a gradient step on an Nvidia GPU. Matrices are row-major.

// Activations in the order of the enum `Activation`; another number is the identity.
enum { MISH, RELU, SILU, TANH, GELU };

// f(x), and where SLOPE its derivative.
template <unsigned F, bool SLOPE>
static __device__ float apply(float x, float *derivative) {
  float value = x, slope = 1.0f;
  if (F == MISH) {
    // Mish by one exponential: x·n/(n + 2) with n = e^x (e^x + 2). From 20 on it is x.
    float e, n, inverse;
    asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(e) : "f"(fminf(x, 20.0f) * 1.4426950f));
    n = e * (e + 2.0f);
    asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(inverse) : "f"(n + 2.0f));
    value = x * (n * inverse);
    slope = n * inverse + x * (4.0f * e * (e + 1.0f) * inverse * inverse);
  } else if (F == RELU) {
    // The product keeps a NaN.
    value = x > 0.0f ? x : 0.0f * x;
    slope = x > 0.0f ? 1.0f : 0.0f;
  } else if (F == SILU) {
    float s = 1.0f / (1.0f + expf(-x));
    value = x * s;
    slope = s * (1.0f + x * (1.0f - s));
  } else if (F == TANH) {
    value = tanhf(x);
    slope = 1.0f - value * value;
  } else if (F == GELU) {
    // x·s with s = σ(2u), where u is what GELU's tanh is of.
    float square = x * x, s = 1.0f / (1.0f + expf(-1.5957692f * x * (1.0f + 0.044715f * square)));
    value = x * s;
    slope = s >= 1.0f || s <= 0.0f ? s : s + value * (1.0f - s) * 1.5957692f * (1.0f + 0.134145f * square);
  }
  if (SLOPE) *derivative = slope;
  return value;
}

// Coefficients of a reverse step of a diffusion.
struct ReverseStep {
  float deviation, scale, clean_bound, from_clean, from_noisy, noise, bound;
};

// clamp(from_clean·clean + from_noisy·x + noise·z), where clean is the predicted x_0; *z is not read without noise.
static __device__ float reverse(ReverseStep s, float x, float epsilon, const float *z) {
  float clean = (x - s.deviation * epsilon) * s.scale;
  // Comparisons that keep a NaN.
  clean = clean > s.clean_bound ? s.clean_bound : clean < -s.clean_bound ? -s.clean_bound : clean;
  float next = s.from_clean * clean + s.from_noisy * x + (s.noise == 0.0f ? 0.0f : s.noise * *z);
  return next > s.bound ? s.bound : next < -s.bound ? -s.bound : next;
}

// The sum over a block of 256 threads, in a fixed order; every thread gets it.
static __device__ float block_sum(float x) {
  __shared__ float sums[256];
  __syncthreads();
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
  if (blockIdx.x == 0 && threadIdx.x == 0) *norm = length;
  for (unsigned i = blockIdx.x * 256 + threadIdx.x; i < count; i += gridDim.x * 256) {
    float g = gradient[i] * scale;
    float first = 0.9f * m[i] + 0.1f * g, second = 0.999f * v[i] + 0.001f * g * g;
    m[i] = first;
    v[i] = second;
    p[i] -= rates[0] * first / (sqrtf(second) * rates[2] + 1e-8f) + rates[1] * p[i];
  }
}

// target += rate·(online - target).
extern "C" __global__ void ema(float *target, const float *online, unsigned count, float rate) {
  unsigned i = blockIdx.x * blockDim.x + threadIdx.x;
  if (i < count) target[i] += rate * (online[i] - target[i]);
}

// weight·mean((x - y)²) + mean(x·pull) over `all` numbers, by one block; without a weight the first mean. y has `count` numbers,
// each for all members.
extern "C" __global__ void squared_error(const float *x, const float *y, const float *weight, const float *pull, float *out,
                                         unsigned all, unsigned count) {
  float sum = 0.0f, along = 0.0f;
  for (unsigned i = threadIdx.x; i < all; i += 256) {
    float difference = x[i] - y[i % count];
    sum += difference * difference;
    if (weight) along += x[i] * pull[i];
  }
  sum = block_sum(weight ? *weight * sum + along : sum);
  if (threadIdx.x == 0) *out = sum / all;
}

// Its gradient, given the result's.
extern "C" __global__ void squared_error_gradient(const float *x, const float *y, const float *weight, const float *pull,
                                                  const float *gradient, float *out, unsigned all, unsigned count) {
  unsigned i = blockIdx.x * blockDim.x + threadIdx.x;
  if (i >= all) return;
  float twice = 2.0f * (x[i] - y[i % count]);
  out[i] = *gradient / all * (weight ? *weight * twice + pull[i] : twice);
}

// QUAD's guidance, Eq. 10 and 21 to 24 of its paper, by one block: from the critics' values members × rows and gradients
// members × rows × a, the predicted noise rows × a and ν̂². out: the mean gradient rows × a, then σ² and λ of each row, the
// share of rows where δ decides λ, and the new ν̂².
extern "C" __global__ void guide(const float *values, const float *gradients, const float *predicted,
                                 const float *nu_squared, float *out, unsigned members, unsigned rows, unsigned a,
                                 float tau, float delta, float rate) {
  float *sigma_squared = out + rows * a, *lambda = sigma_squared + rows, sum = 0.0f;
  for (unsigned i = threadIdx.x; i < members * rows; i += 256) sum += fabsf(values[i]);
  float scale = block_sum(sum) / (members * rows) + 1e-6f;
  sum = 0.0f;
  for (unsigned row = threadIdx.x; row < rows; row += 256) {
    const float *direction = predicted + row * a, *gradient = gradients + row * a;
    float size = 0.0f, mean = 0.0f, variance = 0.0f;
    for (unsigned i = 0; i < a; ++i) size += direction[i] * direction[i];
    size = sqrtf(size) + 1e-8f;
    auto alignment = [&](unsigned k) {
      float along = 0.0f;
      for (unsigned i = 0; i < a; ++i) along += gradient[k * rows * a + i] / scale * (direction[i] / size);
      return along;
    };
    for (unsigned k = 0; k < members; ++k) mean += alignment(k);
    mean /= members;
    for (unsigned k = 0; k < members; ++k) variance += (alignment(k) - mean) * (alignment(k) - mean);
    for (unsigned i = 0; i < a; ++i) {
      float whole = 0.0f;
      for (unsigned k = 0; k < members; ++k) whole += gradient[k * rows * a + i] / scale;
      out[row * a + i] = whole / members;
    }
    sigma_squared[row] = variance / members;
    lambda[row] = mean; // until ν̂² is known
    sum += mean;
  }
  float center = block_sum(sum) / rows;
  sum = 0.0f;
  for (unsigned row = threadIdx.x; row < rows; row += 256) sum += (lambda[row] - center) * (lambda[row] - center);
  float spread = block_sum(sum) / rows, before = *nu_squared;
  float nu = before < 0.0f ? spread : before + (spread - before) * rate;
  sum = 0.0f;
  for (unsigned row = threadIdx.x; row < rows; row += 256) {
    float denominator = sigma_squared[row] / tau + delta + nu;
    lambda[row] = nu / denominator;
    sum += denominator < 100.0f * delta ? 1.0f : 0.0f;
  }
  sum = block_sum(sum);
  if (threadIdx.x == 0) lambda[rows] = sum / rows, lambda[rows + 1] = nu;
}
