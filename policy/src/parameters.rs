//! Weights as flat vectors in memory, as named tensors in files.
//!
//! Names: `actor.time.{0,1}`, `actor.trunk.{0..3}` and `critic.{0..3}`, each with `.kernel` `[in, out]` and `.bias`
//! `[out]`; the critics' carry a leading K. A layer computes `x · kernel + bias`.

use crate::mlp::Mlp;
use crate::{Architecture, CriticEnsemble, NoisePredictor, PolicyError};
use rand::Rng;
use safetensors::tensor::TensorView;
use safetensors::{Dtype, SafeTensors};
use std::collections::BTreeSet;

/// The weights of an actor and its critic ensemble (or anything of their shape: gradients, Adam's moments).
#[derive(Clone, Debug, PartialEq)]
pub struct Parameters {
    architecture: Architecture,
    /// The noise predictor's.
    pub actor: Vec<f32>,
    /// The ensemble's, critic after critic.
    pub critics: Vec<f32>,
}

/// A named tensor's place in the flat vectors: `len` numbers at `offset`, and again every `stride` for each critic.
struct Place {
    name: String,
    shape: Vec<usize>,
    critic: bool,
    offset: usize,
    len: usize,
}

fn places(architecture: &Architecture) -> Vec<Place> {
    let mut places = Vec::new();
    let mut layers = |network: &str, mlp: &Mlp, start: usize, critics: Option<usize>| {
        for layer in 0..mlp.layers() {
            let (inputs, outputs) = mlp.shape(layer);
            let kernel = start + mlp.offset(layer);
            for (kind, shape, offset) in
                [("kernel", vec![inputs, outputs], kernel), ("bias", vec![outputs], kernel + inputs * outputs)]
            {
                places.push(Place {
                    name: format!("{network}.{layer}.{kind}"),
                    len: shape.iter().product(),
                    shape: critics.into_iter().chain(shape).collect(),
                    critic: critics.is_some(),
                    offset,
                });
            }
        }
    };
    let actor = NoisePredictor::new(architecture);
    let (time, trunk) = actor.layers();
    layers("actor.time", time, 0, None);
    layers("actor.trunk", trunk, time.len(), None);
    layers("critic", &Mlp::new(&architecture.critic_widths()), 0, Some(architecture.critics));
    places
}

impl Parameters {
    /// All zero.
    pub fn zeros(architecture: &Architecture) -> Self {
        Self {
            architecture: *architecture,
            actor: vec![0.0; NoisePredictor::new(architecture).parameters()],
            critics: vec![0.0; CriticEnsemble::new(architecture).parameters()],
        }
    }

    /// Xavier-uniform kernels, U(±sqrt(6/(in + out))), and zero biases; each critic from its own draws.
    pub fn initialise(architecture: &Architecture, generator: &mut impl Rng) -> Self {
        let mut parameters = Self::zeros(architecture);
        for place in places(architecture).iter().filter(|place| place.name.ends_with("kernel")) {
            let fans = &place.shape[place.shape.len() - 2..];
            let bound = (6.0 / (fans[0] + fans[1]) as f32).sqrt();
            for chunk in parameters.chunks_mut(place) {
                chunk.fill_with(|| generator.random_range(-bound..bound));
            }
        }
        parameters
    }

    /// The shapes.
    pub fn architecture(&self) -> &Architecture {
        &self.architecture
    }

    fn chunks_mut<'a>(&'a mut self, place: &'a Place) -> impl Iterator<Item = &'a mut [f32]> {
        let critics = self.architecture.critics;
        let (flat, stride) = match place.critic {
            true => (&mut self.critics, CriticEnsemble::new(&self.architecture).parameters_per_critic()),
            false => (&mut self.actor, usize::MAX),
        };
        flat.chunks_mut(stride).take(critics).map(|chunk| &mut chunk[place.offset..place.offset + place.len])
    }

    fn gather(&self, place: &Place) -> Vec<u8> {
        let (flat, stride) = match place.critic {
            true => (&self.critics, CriticEnsemble::new(&self.architecture).parameters_per_critic()),
            false => (&self.actor, usize::MAX),
        };
        let chunks = flat.chunks(stride).map(|chunk| &chunk[place.offset..place.offset + place.len]);
        let mut bytes = vec![0; chunks.len() * place.len * size_of::<f32>()];
        for (bytes, chunk) in bytes.chunks_exact_mut(place.len * size_of::<f32>()).zip(chunks) {
            bytes.chunks_exact_mut(size_of::<f32>()).zip(chunk).for_each(|(b, x)| b.copy_from_slice(&x.to_le_bytes()));
        }
        bytes
    }

    /// A safetensors file of all tensors, always the same bytes for the same numbers.
    pub fn to_safetensors(&self) -> Result<Vec<u8>, PolicyError> {
        let places = places(&self.architecture);
        let bytes: Vec<_> = places.iter().map(|place| self.gather(place)).collect();
        let mut views = Vec::with_capacity(places.len());
        for (place, bytes) in places.iter().zip(&bytes) {
            views.push((&place.name, TensorView::new(Dtype::F32, place.shape.clone(), bytes)?));
        }
        Ok(safetensors::serialize(views, None)?)
    }

    /// Reads a safetensors file that holds exactly this architecture's tensors.
    pub fn from_safetensors(architecture: &Architecture, bytes: &[u8]) -> Result<Self, PolicyError> {
        let file = SafeTensors::deserialize(bytes)?;
        let known: BTreeSet<_> = places(architecture).into_iter().map(|place| place.name).collect();
        if let Some(name) = file.names().into_iter().find(|name| !known.contains(*name)) {
            return Err(PolicyError::Unexpected(name.to_string()));
        }
        Self::read(architecture, &file, "")
    }

    /// Reads the tensors whose names carry `prefix` from a file that may hold others too.
    pub fn read(architecture: &Architecture, file: &SafeTensors<'_>, prefix: &str) -> Result<Self, PolicyError> {
        let mut tensors = Vec::new();
        for place in places(architecture) {
            let name = format!("{prefix}{}", place.name);
            let Ok(tensor) = file.tensor(&name) else { return Err(PolicyError::Missing(name)) };
            if tensor.dtype() != Dtype::F32 {
                return Err(PolicyError::Type { name, found: format!("{:?}", tensor.dtype()) });
            }
            if tensor.shape() != place.shape {
                return Err(PolicyError::Shape { name, found: tensor.shape().to_vec(), expected: place.shape });
            }
            tensors.push((place, name, tensor));
        }
        // Not before: an architecture that somebody made up could ask for any amount of memory.
        let mut parameters = Self::zeros(architecture);
        for (place, name, tensor) in tensors {
            let mut numbers = tensor.data().chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]]));
            let mut finite = true;
            for chunk in parameters.chunks_mut(&place) {
                for (x, number) in chunk.iter_mut().zip(&mut numbers) {
                    *x = number;
                    finite &= number.is_finite();
                }
            }
            if !finite {
                return Err(PolicyError::NotFinite(name));
            }
        }
        Ok(parameters)
    }
}
