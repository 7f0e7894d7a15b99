// Dense layers on an Nvidia GPU. A block takes a tile of one network's rows through all layers: activations stay in shared
// memory, and weights come from the L2 cache.
//
// Tensor cores multiply numbers of 11 bits, TF32. A number of f32 is the sum of two of those, and three products of them give
// a product to some 22 bits.

// A tile has ROWS rows, a multiple of 8.
enum { WARPS = 8, GROUPS = ROWS / 8, EACH = ROWS / WARPS, NARROW = 8 };

// widths[0] inputs, widths[1] … hidden, widths[count] outputs. From `start` on, the weights hold for each layer the members'
// kernels, inputs × outputs, then their biases.
struct Shape {
  unsigned start, members, count, activation, widths[66];
};

// Some columns of the inputs, of which `repeat` rows are the same.
struct Part {
  const float *x;
  unsigned width, repeat;
};

static __device__ unsigned padded(unsigned width) { return (width + 15) / 16 * 16; }

// Two or four numbers of a row from a column on; 0 outside of the matrix.
template <class V>
static __device__ V fetch(const float *matrix, unsigned rows, unsigned width, unsigned row, unsigned column) {
  V v = {};
#pragma unroll
  for (unsigned j = 0; j < sizeof v / 4; ++j)
    if (row < rows && column + j < width) (&v.x)[j] = matrix[(size_t)row * width + column + j];
  return v;
}

static __device__ void multiply(float *c, const unsigned *a, const unsigned *b) {
  asm("mma.sync.aligned.m16n8k8.row.col.f32.tf32.tf32.f32 {%0,%1,%2,%3}, {%4,%5,%6,%7}, {%8,%9}, {%0,%1,%2,%3};"
      : "+f"(c[0]), "+f"(c[1]), "+f"(c[2]), "+f"(c[3])
      : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(b[0]), "r"(b[1]));
}

// x as a number for tensor cores, and the rest.
static __device__ void split(float x, unsigned *high, unsigned *low) {
  *high = __float_as_uint(x) & 0xffffe000;
  *low = __float_as_uint(x - __uint_as_float(*high));
}

// c += (x·w)ᵀ, for the tile's rows of x and 32 columns of w from `from` on. A thread, with t = lane % 4 and g = lane / 4, has
// in c[group][tile] of the columns from + 16 tile + 2g and the next the rows 8 group + 2t and the next.
// WHOLE: the thread's weights need no check.
template <bool TRANSPOSED, bool WHOLE>
static __device__ void product(float (*c)[2][4], const float *x, unsigned stride, const float *w, unsigned depth,
                               unsigned width, unsigned from) {
  unsigned g = threadIdx.x % 32 / 4, t = threadIdx.x % 4, lead = TRANSPOSED ? depth : width;
  x += g * stride + 4 * t, from += 2 * g;
  const float *mine = w + (TRANSPOSED ? from * lead + 4 * t : 4 * t * lead + from);
  // Weights of inputs k + 4t + 2 half and the next; of each the two columns.
  float next[2][2][4];
  auto fetch_weights = [&](unsigned k) {
#pragma unroll
    for (unsigned tile = 0; tile < 2; ++tile)
#pragma unroll
      for (unsigned i = 0; i < (TRANSPOSED ? 2 : 4); ++i)
        if (TRANSPOSED) {
          float4 v = WHOLE ? *(const float4 *)(mine + (16 * tile + i) * lead + k)
                           : fetch<float4>(w, width, depth, from + 16 * tile + i, k + 4 * t);
          next[tile][0][i] = v.x, next[tile][0][2 + i] = v.y, next[tile][1][i] = v.z, next[tile][1][2 + i] = v.w;
        } else {
          float2 v = WHOLE ? *(const float2 *)(mine + (k + i) * lead + 16 * tile)
                           : fetch<float2>(w, depth, width, k + 4 * t + i, from + 16 * tile);
          next[tile][i / 2][i % 2 * 2] = v.x, next[tile][i / 2][i % 2 * 2 + 1] = v.y;
        }
  };
  fetch_weights(0);
#pragma unroll 1
  for (unsigned k = 0; k < depth; k += 16) {
    unsigned high[2][2][4], low[2][2][4];
#pragma unroll
    for (unsigned i = 0; i < 16; ++i)
      split(next[i / 8][i / 4 % 2][i % 4], &high[i / 8][i / 4 % 2][i % 4], &low[i / 8][i / 4 % 2][i % 4]);
    if (k + 16 < depth) fetch_weights(k + 16);
#pragma unroll
    for (unsigned half = 0; half < 2; ++half) {
      unsigned a[GROUPS][2], rest[GROUPS][2];
#pragma unroll
      for (unsigned group = 0; group < GROUPS; ++group) {
        float2 v = *(const float2 *)(x + 8 * group * stride + k + 2 * half);
        split(v.x, &a[group][0], &rest[group][0]);
        split(v.y, &a[group][1], &rest[group][1]);
      }
#pragma unroll
      for (unsigned i = 0; i < 2 * GROUPS; ++i) multiply(c[i / 2][i % 2], low[i % 2][half], a[i / 2]);
#pragma unroll
      for (unsigned i = 0; i < 2 * GROUPS; ++i) multiply(c[i / 2][i % 2], high[i % 2][half], rest[i / 2]);
#pragma unroll
      for (unsigned i = 0; i < 2 * GROUPS; ++i) multiply(c[i / 2][i % 2], high[i % 2][half], a[i / 2]);
    }
  }
}

// y = x·w + bias in shared memory, with columns of 0 up to a multiple of 16; without a bias where it is null. Where `narrow` and
// of few columns, a warp sums each number in f32.
template <bool TRANSPOSED>
static __device__ void layer(const float *x, unsigned stride, const float *w, const float *bias, unsigned depth,
                             unsigned width, bool narrow, float *y, unsigned y_stride) {
  unsigned warp = threadIdx.x / 32, lane = threadIdx.x % 32;
  __syncthreads();
  if (narrow && width <= NARROW) {
#pragma unroll 1
    for (unsigned n = 0; n < width; ++n) {
      float sums[EACH] = {};
#pragma unroll 8
      for (unsigned k = lane; k < depth; k += 32) {
        float of_w = w[TRANSPOSED ? n * depth + k : k * width + n];
#pragma unroll
        for (unsigned i = 0; i < EACH; ++i) sums[i] += x[(i * WARPS + warp) * stride + k] * of_w;
      }
#pragma unroll
      for (unsigned i = 0; i < EACH; ++i) {
        for (unsigned other = 16; other > 0; other /= 2) sums[i] += __shfl_xor_sync(~0u, sums[i], other);
        if (lane == 0) y[(i * WARPS + warp) * y_stride + n] = sums[i] + (bias ? bias[n] : 0.0f);
      }
    }
  } else {
    bool whole = depth % 16 == 0 && width % 32 == 0 && (size_t)w % 16 == 0;
#pragma unroll 1
    for (unsigned from = 32 * warp; from < width; from += 32 * WARPS) {
      float c[GROUPS][2][4];
#pragma unroll
      for (unsigned i = 0; i < 4; ++i) {
        unsigned n = from + i / 2 * 16 + lane / 4 * 2 + i % 2;
        float start = bias && n < width ? bias[n] : 0.0f;
#pragma unroll
        for (unsigned group = 0; group < GROUPS; ++group) c[group][i / 2][i % 2 * 2] = c[group][i / 2][i % 2 * 2 + 1] = start;
      }
      if (whole) product<TRANSPOSED, true>(c, x, stride, w, depth, width, from);
      else product<TRANSPOSED, false>(c, x, stride, w, depth, width, from);
#pragma unroll
      for (unsigned i = 0; i < 4 * GROUPS; ++i) {
        const float *numbers = c[i / 4][i / 2 % 2] + i % 2;
        unsigned row = i / 4 * 8 + lane % 4 * 2 + i % 2, n = from + i / 2 % 2 * 16 + lane / 4 * 2;
        if (n < padded(width)) *(float2 *)(y + row * y_stride + n) = make_float2(numbers[0], numbers[2]);
      }
    }
  }
  __syncthreads();
}

// Calls put(row, column, get(row, column)) for all numbers of a tile, after several calls of get.
template <class Get, class Put>
static __device__ void for_each(unsigned width, Get get, Put put) {
  unsigned warp = threadIdx.x / 32;
#pragma unroll 1
  for (unsigned from = threadIdx.x % 32; from < width; from += 64) {
    float numbers[2 * EACH];
#pragma unroll
    for (unsigned i = 0; i < 2 * EACH; ++i) {
      unsigned row = i / 2 * WARPS + warp, n = from + i % 2 * 32;
      numbers[i] = n < width ? get(row, n) : 0.0f;
    }
#pragma unroll
    for (unsigned i = 0; i < 2 * EACH; ++i) {
      unsigned row = i / 2 * WARPS + warp, n = from + i % 2 * 32;
      if (n < width) put(row, n, numbers[i]);
    }
  }
}

// Rows from `first` on of parts side by side, then columns of 0.
static __device__ void gather(float *x, unsigned stride, const Part *parts, unsigned first, unsigned rows) {
  unsigned ends[3] = {parts[0].width, parts[0].width + parts[1].width, parts[0].width + parts[1].width + parts[2].width};
  for_each(
      padded(ends[2]),
      [&](unsigned row, unsigned n) {
        unsigned p = n < ends[0] ? 0 : n < ends[1] ? 1 : 2;
        const float *from = p == 0 ? parts[0].x : p == 1 ? parts[1].x : parts[2].x;
        unsigned repeat = p == 0 ? parts[0].repeat : p == 1 ? parts[1].repeat : parts[2].repeat;
        unsigned width = p == 0 ? ends[0] : p == 1 ? parts[1].width : parts[2].width;
        unsigned column = n - (p == 0 ? 0 : p == 1 ? ends[0] : ends[1]);
        return n < ends[2] && first + row < rows ? from[(first + row) / repeat * width + column] : 0.0f;
      },
      [&](unsigned row, unsigned n, float number) { x[row * stride + n] = number; });
}

// Of a layer: inputs, outputs, and one member's kernel and bias.
struct Layer {
  unsigned inputs, outputs;
  const float *kernel, *bias;
};

static __device__ Layer layer_of(const float *weights, const Shape &s, unsigned index, unsigned member) {
  for (unsigned i = 0; i < index; ++i) weights += s.members * (s.widths[i] + 1) * s.widths[i + 1];
  unsigned in = s.widths[index], out = s.widths[index + 1];
  weights += s.start;
  return {in, out, weights + member * in * out, weights + s.members * in * out + member * out};
}

// Numbers of all hidden layers below this one, for as many rows.
static __device__ size_t below(const Shape &s, unsigned layer, unsigned rows) {
  size_t width = 0;
  for (unsigned i = 1; i < layer; ++i) width += s.widths[i];
  return width * rows * s.members;
}

// y = f(y) for a layer's outputs; where SAVE, also to `inputs` and the slopes to `slopes`, for the rows that exist.
template <unsigned F, bool SAVE>
static __device__ void activate_tile(float *y, unsigned stride, unsigned width, float *inputs, float *slopes, unsigned rows) {
  for_each(
      width, [&](unsigned row, unsigned n) { return y[row * stride + n]; },
      [&](unsigned row, unsigned n, float z) {
        float derivative, value = apply<F, SAVE>(z, &derivative);
        y[row * stride + n] = value;
        if (!SAVE || row >= rows) return;
        inputs[row * width + n] = value;
        slopes[row * width + n] = derivative;
      });
}

// One member's layers over the tile x, with y as memory for another. Where SAVE, activations and slopes go to `inputs` and
// `slopes`. Returns the outputs.
template <bool SAVE>
static __device__ float *forward_tile(float *x, float *y, unsigned stride, const float *weights, const Shape &s,
                                      unsigned member, unsigned first, unsigned rows, float *inputs, float *slopes) {
#pragma unroll 1
  for (unsigned l = 0;; ++l) {
    bool last = l + 1 == s.count;
    Layer here = layer_of(weights, s, l, member);
    layer<false>(x, stride, here.kernel, here.bias, here.inputs, here.outputs, last, y, stride);
    if (last) return y;
    size_t before = below(s, l + 1, rows) + ((size_t)member * rows + first) * here.outputs;
    float *values = SAVE ? inputs + before : nullptr, *derivatives = SAVE ? slopes + before : nullptr;
    unsigned own = rows - first;
    switch (s.activation) {
      case MISH: activate_tile<MISH, SAVE>(y, stride, here.outputs, values, derivatives, own); break;
      case RELU: activate_tile<RELU, SAVE>(y, stride, here.outputs, values, derivatives, own); break;
      case SILU: activate_tile<SILU, SAVE>(y, stride, here.outputs, values, derivatives, own); break;
      case TANH: activate_tile<TANH, SAVE>(y, stride, here.outputs, values, derivatives, own); break;
      default: activate_tile<GELU, SAVE>(y, stride, here.outputs, values, derivatives, own);
    }
    float *other = x;
    x = y, y = other;
  }
}

// out[members × rows × outputs]; where not null also the inputs of all layers, first the networks' own, then `inputs` and
// `slopes` of each hidden layer, members × rows × width.
extern "C" __global__ void __launch_bounds__(32 * WARPS, 2)
    forward(const float *weights, Shape s, Part one, Part two, Part three, float *out, float *inputs, float *slopes,
            unsigned rows, unsigned stride) {
  extern __shared__ float4 shared[];
  float *x = (float *)shared, *y = x + ROWS * stride;
  unsigned first = blockIdx.x * ROWS, member = blockIdx.y, width = s.widths[0], outputs = s.widths[s.count];
  Part parts[3] = {one, two, three};
  gather(x, stride, parts, first, rows);
  if (inputs) {
    __syncthreads();
    if (member == 0)
      for_each(
          width, [&](unsigned row, unsigned n) { return x[row * stride + n]; },
          [&](unsigned row, unsigned n, float number) {
            if (first + row < rows) inputs[(size_t)(first + row) * width + n] = number;
          });
    inputs += (size_t)rows * width;
    y = forward_tile<true>(x, y, stride, weights, s, member, first, rows, inputs, slopes);
  } else {
    y = forward_tile<false>(x, y, stride, weights, s, member, first, rows, inputs, slopes);
  }
  for (unsigned i = threadIdx.x; i < min(ROWS, rows - first) * outputs; i += blockDim.x)
    out[((size_t)member * rows + first) * outputs + i] = y[i / outputs * stride + i % outputs];
}

// The reverse process of a diffusion: out[rows × a], which starts as the first of `count` noises. `embeddings` and `steps` have
// a row for each t.
extern "C" __global__ void __launch_bounds__(32 * WARPS, 2)
    sample(const float *weights, Shape s, Part observations, Part embeddings, const float *noise, const ReverseStep *steps,
           float *out, unsigned count, unsigned rows, unsigned stride) {
  extern __shared__ float4 shared[];
  float *x = (float *)shared, *y = x + ROWS * stride;
  unsigned first = blockIdx.x * ROWS, a = s.widths[s.count], numbers = min(ROWS, rows - first) * a;
  out += first * a, noise += first * a;
  for (unsigned i = threadIdx.x; i < numbers; i += blockDim.x) out[i] = noise[i];
#pragma unroll 1
  for (unsigned t = count; t-- > 0;) {
    noise += rows * a;
    __syncthreads();
    Part parts[3] = {observations, {out - first * a, a, 1}, {embeddings.x + t * embeddings.width, embeddings.width, rows}};
    gather(x, stride, parts, first, rows);
    float *epsilon = forward_tile<false>(x, y, stride, weights, s, 0, first, rows, nullptr, nullptr);
    for (unsigned i = threadIdx.x; i < numbers; i += blockDim.x)
      out[i] = reverse(steps[t], out[i], epsilon[i / a * stride + i % a], noise + i);
  }
}

// deltas: the gradients before each hidden layer's activation, in the layout of `slopes`, given the outputs' (null: 1). Where
// of_inputs is not null: those of the last `columns` inputs, members × rows × columns.
extern "C" __global__ void __launch_bounds__(32 * WARPS, 2)
    backward(const float *weights, Shape s, const float *gradient, const float *slopes, float *deltas, float *of_inputs,
             unsigned columns, unsigned rows, unsigned stride) {
  extern __shared__ float4 shared[];
  float *x = (float *)shared, *y = x + ROWS * stride;
  unsigned first = blockIdx.x * ROWS, member = blockIdx.y, outputs = s.widths[s.count];
  bool ones = !gradient;
  gradient += ((size_t)member * rows + first) * outputs;
  for_each(
      padded(outputs),
      [&](unsigned row, unsigned n) {
        return n >= outputs || first + row >= rows ? 0.0f : ones ? 1.0f : gradient[row * outputs + n];
      },
      [&](unsigned row, unsigned n, float number) { x[row * stride + n] = number; });
#pragma unroll 1
  for (unsigned l = s.count - 1;; --l) {
    Layer here = layer_of(weights, s, l, member);
    if (l == 0 && !of_inputs) return;
    unsigned from = l == 0 ? here.inputs - columns : 0, width = here.inputs - from;
    layer<true>(x, stride, here.kernel + from * here.outputs, nullptr, here.outputs, width, l == 0, y, stride);
    size_t before = below(s, l, rows) + ((size_t)member * rows + first) * width;
    for_each(
        width,
        [&](unsigned row, unsigned n) { return l > 0 && first + row < rows ? slopes[before + row * width + n] : 1.0f; },
        [&](unsigned row, unsigned n, float slope) {
          float *z = y + row * stride + n;
          *z *= slope;
          if (first + row < rows) (l > 0 ? deltas : of_inputs)[before + row * width + n] = *z;
        });
    if (l == 0) return;
    float *other = x;
    x = y, y = other;
  }
}

// The gradient of the weights, in their layout, given what `forward` and `backward` made. A block has ROWS inputs of one
// layer; behind the last input is the bias, whose input is 1.
extern "C" __global__ void __launch_bounds__(32 * WARPS, 2)
    gradients(Shape s, const float *inputs, const float *gradient, const float *deltas, float *out, unsigned rows,
              unsigned stride, unsigned y_stride) {
  extern __shared__ float4 shared[];
  float *x = (float *)shared, *y = x + ROWS * stride;
  unsigned member = blockIdx.y, l = 0, tile = blockIdx.x;
  while (tile > s.widths[l] / ROWS) tile -= s.widths[l++] / ROWS + 1;
  Layer here = layer_of(out, s, l, member);
  unsigned width = here.inputs, outputs = here.outputs, at_once = stride - 16;
  const float *input = l == 0 ? inputs : inputs + (size_t)rows * s.widths[0] + below(s, l, rows) + (size_t)member * rows * width;
  const float *delta =
      (l + 1 == s.count ? gradient : deltas + below(s, l + 1, rows)) + (size_t)member * rows * outputs;
  bool whole = width % 4 == 0 && (size_t)input % 16 == 0;
#pragma unroll 1
  for (unsigned first = 0; first < rows; first += at_once) {
    unsigned count = min(at_once, rows - first);
    __syncthreads();
#pragma unroll 1
    for (unsigned k = threadIdx.x; k < padded(count); k += blockDim.x)
    {
      float4 numbers[ROWS / 4];
#pragma unroll
      for (unsigned i = 0; i < ROWS / 4; ++i) {
        unsigned column = tile * ROWS + 4 * i;
        if (whole && k < count && column < width) numbers[i] = *(const float4 *)(input + (size_t)(first + k) * width + column);
        else numbers[i] = fetch<float4>(input, k < count ? rows : 0, width, first + k, column);
      }
      unsigned ones = k < count ? width - tile * ROWS : ~0u;
#pragma unroll
      for (unsigned i = 0; i < ROWS; ++i) x[i * stride + k] = i == ones ? 1.0f : (&numbers[i / 4].x)[i % 4];
    }
    layer<false>(x, stride, delta + (size_t)first * outputs, nullptr, count, outputs, true, y, y_stride);
    for_each(
        outputs, [&](unsigned row, unsigned n) { return y[row * y_stride + n]; },
        [&](unsigned row, unsigned n, float number) {
          unsigned i = tile * ROWS + row;
          if (i > width) return;
          float *to = (float *)(i < width ? here.kernel + i * outputs : here.bias) + n;
          *to = number + (first > 0 ? *to : 0.0f);
        });
  }
}
