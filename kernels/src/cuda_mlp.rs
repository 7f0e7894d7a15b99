//! Dense layers on an Nvidia GPU, each a kernel for all layers of all networks: forward, backward,
//! and the sampler of a diffusion. `mlp.cu` has the kernels. Their products on tensor cores are as
//! exact as those of f32 but for the last two bits.

use crate::activation::Activation;
use crate::cuda_kernels::{Result, Tiles, kernels};
use cudarc::driver::{
    CudaSlice, CudaStream, CudaView, DevicePtr, DeviceRepr, LaunchConfig, PushKernelArg,
};
use std::sync::Arc;

/// Threads of a block; `mlp.cu` counts on it.
const THREADS: u32 = 256;
/// Widest layer of which a block's memory holds a tile.
const WIDEST: usize = 512;
/// Largest number of layers.
const LAYERS: usize = 65;

/// Networks of dense layers, and where their weights are in a vector: from a start on, for each
/// layer the members' kernels `inputs × outputs`, then their biases.
#[derive(Clone, Copy)]
#[repr(C)]
pub struct Dense {
    start: u32,
    members: u32,
    count: u32,
    activation: u32,
    widths: [u32; LAYERS + 1],
}

// SAFETY: `Shape` in mlp.cu has the same fields.
unsafe impl DeviceRepr for Dense {}

/// Some columns of networks' inputs.
pub struct Part<'a> {
    /// Rows of the columns, `rows/repeat × width`.
    pub numbers: &'a CudaView<'a, f32>,
    /// Number of columns.
    pub width: usize,
    /// Number of consecutive rows that are the same.
    pub repeat: usize,
}

/// A part as kernels take it.
#[derive(Clone, Copy)]
#[repr(C)]
struct Columns(u64, u32, u32);

// SAFETY: `Part` in mlp.cu has the same fields.
unsafe impl DeviceRepr for Columns {}

impl Part<'_> {
    fn columns(&self, stream: &CudaStream) -> Columns {
        Columns(self.numbers.device_ptr(stream).0, self.width as u32, self.repeat as u32)
    }
}

/// Coefficients of a reverse step: `deviation, scale, clean_bound, from_clean, from_noisy, noise,
/// bound`. From `clean = (x - deviation·ε)·scale` within ±clean_bound it makes `from_clean·clean +
/// from_noisy·x + noise·z` within ±bound; bounds can be infinite.
const COEFFICIENTS: usize = 7;

/// Left by a forward pass for the backward pass.
pub struct Saved {
    /// The networks' inputs `rows × width`, then those of the later layers, each `members × rows ×
    /// width`.
    inputs: CudaSlice<f32>,
    /// Slopes of the hidden layers' activations, each `members × rows × width`.
    slopes: CudaSlice<f32>,
}

impl Dense {
    /// Networks whose weights begin at `start`, with the widths of inputs, hidden layers and outputs.
    /// `None` if a tile does not fit into a block's memory.
    pub fn new(
        start: usize,
        members: usize,
        widths: &[usize],
        activation: Activation,
    ) -> Option<Self> {
        let fits = widths.len() <= LAYERS + 1 && widths.iter().all(|width| *width <= WIDEST);
        fits.then(|| {
            let mut padded = [0; LAYERS + 1];
            for (to, width) in padded.iter_mut().zip(widths) {
                *to = *width as u32;
            }
            let [start, members, count] = [start, members, widths.len() - 1].map(|x| x as u32);
            Self { start, members, count, activation: activation as u32, widths: padded }
        })
    }

    /// Numbers between two rows of a tile, such that a warp's reads fall on different banks.
    fn stride(&self) -> u32 {
        let widest = self.widths[..=self.count as usize].iter().copied().max();
        widest.unwrap_or(0).next_multiple_of(32) + 16
    }

    /// Number of networks.
    pub fn members(&self) -> usize {
        self.members as usize
    }

    /// Inputs of each.
    pub fn inputs(&self) -> usize {
        self.widths[0] as usize
    }

    /// Outputs of each.
    pub fn outputs(&self) -> usize {
        self.widths[self.count as usize] as usize
    }

    /// Numbers of all hidden layers for this many rows.
    fn hidden(&self, rows: usize) -> usize {
        let hidden = &self.widths[1..self.count as usize];
        hidden.iter().sum::<u32>() as usize * self.members as usize * rows
    }

    /// A grid for kernels with two tiles in each block's memory, and their stride.
    fn grid(&self, tiles: &Tiles, rows: usize) -> (LaunchConfig, u32) {
        let stride = self.stride();
        let config = LaunchConfig {
            grid_dim: ((rows as u32).div_ceil(tiles.rows), self.members, 1),
            block_dim: (THREADS, 1, 1),
            shared_mem_bytes: 2 * 4 * tiles.rows * stride,
        };
        (config, stride)
    }

    /// The outputs, `members × rows × outputs`, for parts of the inputs side by side, at most three;
    /// and with `save` what [`Self::backward`] needs.
    pub fn forward(
        &self,
        stream: &Arc<CudaStream>,
        weights: &CudaView<'_, f32>,
        parts: &[Part<'_>],
        rows: usize,
        save: bool,
    ) -> Result<(CudaSlice<f32>, Option<Saved>)> {
        let inputs: usize = parts.iter().map(|part| part.width).sum();
        assert!(
            parts.len() <= 3 && inputs == self.widths[0] as usize,
            "as many inputs as layers take"
        );
        let kernels = kernels(stream)?;
        let tiles = kernels.tiles(rows, self.members);
        let count = self.members() * rows * self.outputs();
        let hidden = self.hidden(rows);
        // SAFETY: the kernel writes every number.
        let mut out = unsafe { stream.alloc::<f32>(count)? };
        let mut saved = match save {
            // SAFETY: as above.
            true => Some(unsafe {
                let inputs = stream.alloc::<f32>(rows * inputs + hidden)?;
                Saved { inputs, slopes: stream.alloc::<f32>(hidden.max(1))? }
            }),
            false => None,
        };
        let mut columns = [Columns(0, 0, 1); 3];
        for (columns, part) in columns.iter_mut().zip(parts) {
            *columns = part.columns(stream);
        }
        let ((config, stride), row_count, none) = (self.grid(tiles, rows), rows as u32, 0_u64);
        let mut launch = stream.launch_builder(&tiles.forward);
        launch.arg(weights).arg(self);
        for columns in &columns {
            launch.arg(columns);
        }
        launch.arg(&mut out);
        match &mut saved {
            Some(Saved { inputs, slopes }) => launch.arg(inputs).arg(slopes),
            None => launch.arg(&none).arg(&none),
        };
        launch.arg(&row_count).arg(&stride);
        // SAFETY: the arguments are those of the kernel.
        unsafe { launch.launch(config)? };
        Ok((out, saved))
    }

    /// Samples of a reverse process, `rows × outputs`: the networks predict the noise ε from
    /// observations, actions and an embedding of t, of which there are as many as steps, `T`. `steps`
    /// are `T × 7` coefficients, `noise` is `T × rows × outputs`: the start, then the z of t = T down
    /// to 2.
    pub fn sample(
        &self,
        stream: &Arc<CudaStream>,
        weights: &CudaView<'_, f32>,
        [observations, embeddings]: [&Part<'_>; 2],
        noise: &CudaView<'_, f32>,
        steps: &CudaView<'_, f32>,
    ) -> Result<CudaSlice<f32>> {
        let count = (steps.len() / COEFFICIENTS) as u32;
        let rows = noise.len() / (count as usize * self.outputs());
        let kernels = kernels(stream)?;
        let tiles = kernels.tiles(rows, 1);
        // SAFETY: the kernel writes every number.
        let mut out = unsafe { stream.alloc::<f32>(rows * self.outputs())? };
        let parts = [observations, embeddings].map(|part| part.columns(stream));
        let ((config, stride), row_count) = (self.grid(tiles, rows), rows as u32);
        let mut launch = stream.launch_builder(&tiles.sample);
        launch.arg(weights).arg(self).arg(&parts[0]).arg(&parts[1]);
        launch.arg(noise).arg(steps);
        launch.arg(&mut out).arg(&count).arg(&row_count).arg(&stride);
        // SAFETY: the arguments are those of the kernel.
        unsafe { launch.launch(config)? };
        Ok(out)
    }

    /// Given the outputs' gradient (`None`: 1), that of the last `columns` inputs, `members × rows ×
    /// columns`, if these are any; and with `weights_gradient`, a vector like the weights', that of the
    /// layers' weights is written there.
    pub fn backward(
        &self,
        stream: &Arc<CudaStream>,
        weights: &CudaView<'_, f32>,
        saved: &Saved,
        (gradient, rows): (Option<&CudaView<'_, f32>>, usize),
        columns: usize,
        weights_gradient: Option<&mut CudaSlice<f32>>,
    ) -> Result<Option<CudaSlice<f32>>> {
        let kernels = kernels(stream)?;
        let tiles = kernels.tiles(rows, self.members);
        // SAFETY: the kernel writes every number.
        let mut deltas = unsafe { stream.alloc::<f32>(saved.slopes.len())? };
        let count = self.members as usize * rows * columns;
        let mut input_gradient = match columns {
            0 => None,
            // SAFETY: as above.
            _ => Some(unsafe { stream.alloc::<f32>(count)? }),
        };
        let ((config, stride), row_count, none) = (self.grid(tiles, rows), rows as u32, 0_u64);
        let last = columns as u32;
        let mut launch = stream.launch_builder(&tiles.backward);
        launch.arg(weights).arg(self);
        match gradient {
            Some(gradient) => launch.arg(gradient),
            None => launch.arg(&none),
        };
        launch.arg(&saved.slopes).arg(&mut deltas);
        match &mut input_gradient {
            Some(gradient) => launch.arg(gradient),
            None => launch.arg(&none),
        };
        launch.arg(&last).arg(&row_count).arg(&stride);
        // SAFETY: the arguments are those of the kernel.
        unsafe { launch.launch(config)? };
        if let (Some(out), Some(gradient)) = (weights_gradient, gradient) {
            self.gradients(stream, saved, (gradient, &deltas), rows, out)?;
        }
        Ok(input_gradient)
    }

    fn gradients(
        &self,
        stream: &Arc<CudaStream>,
        saved: &Saved,
        (gradient, deltas): (&CudaView<'_, f32>, &CudaSlice<f32>),
        rows: usize,
        out: &mut CudaSlice<f32>,
    ) -> Result<()> {
        let kernels = kernels(stream)?;
        let inputs = &self.widths[..self.count as usize];
        let tiles = kernels.tiles(inputs.iter().sum::<u32>() as usize, self.members);
        // Rows that a block holds at a time.
        let at_once = (rows as u32).next_multiple_of(32).min(WIDEST as u32);
        let (row_count, stride, y_stride) = (rows as u32, at_once + 16, self.stride());
        let blocks = inputs.iter().map(|width| width / tiles.rows + 1).sum();
        let config = LaunchConfig {
            grid_dim: (blocks, self.members, 1),
            block_dim: (THREADS, 1, 1),
            shared_mem_bytes: 4 * tiles.rows * (stride + y_stride),
        };
        let mut launch = stream.launch_builder(&tiles.gradients);
        launch.arg(self).arg(&saved.inputs);
        launch.arg(gradient).arg(deltas).arg(out);
        launch.arg(&row_count).arg(&stride).arg(&y_stride);
        // SAFETY: the arguments are those of the kernel.
        unsafe { launch.launch(config)? };
        Ok(())
    }
}
