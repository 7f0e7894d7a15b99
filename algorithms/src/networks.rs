//! Networks in training: their initial weights, optimizers and target networks.
//!
//! An algorithm declares its networks once, with [`networks!`]; constructor and state dict follow.

use candle_core::{Result, Tensor};
use quad_nn::{
    Adam, AdamStep, Ensemble, EnsembleShape, Gradients, Init, Layout, MlpConfig, TensorSpec,
    Weighted, Weights,
};
use std::ops::{Deref, DerefMut};

use super::context::Context;
use super::random::{Purpose, stream};
use super::state_dict::{StateDict, Stateful};

/// Number of critics of the algorithms that take the smaller value of two.
pub(super) const TWIN: usize = 2;

/// V(s) of an ensemble of one, `[n]`.
pub(super) fn state_value(value: &Ensemble, observations: &Tensor) -> Result<Tensor> {
    value.state_values(observations)?.squeeze(0)
}

/// Declares an algorithm with its hyper-parameters, context and networks, or, with a reference to what
/// they need, a struct of networks alone. `new` initializes these in this order, each from its own
/// random stream; a state dict names them after their fields.
macro_rules! networks {
    ($(#[$meta:meta])* $vis:vis struct $name:ident($config:ident: &$type:ty, $init:ident) {
        $($(#[$doc:meta])* $field:ident: $network:ty = $make:expr,)*
    }) => {
        $(#[$meta])*
        $vis struct $name { $($(#[$doc])* pub $field: $network,)* }

        impl $name {
            $vis fn new(
                $config: &$type,
                $init: &mut $crate::networks::Initializer<'_>,
            ) -> candle_core::Result<Self> {
                $(let $field: $network = $make?;)*
                Ok(Self { $($field),* })
            }

            $vis fn state_dict(&mut self) -> $crate::state_dict::StateDict<'_> {
                $crate::state_dict::StateDict::default()
                    $(.with(stringify!($field), &mut self.$field))*
            }
        }
    };
    ($vis:vis struct $name:ident($config:ident: $type:ty, $init:ident) {
        $($(#[$doc:meta])* $field:ident: $network:ty = $make:expr,)*
    }) => {
        $vis struct $name {
            config: $type,
            context: $crate::context::Context,
            $($(#[$doc])* $field: $network,)*
        }

        impl $name {
            $vis fn new(
                $config: $type,
                context: $crate::context::Context,
            ) -> candle_core::Result<Self> {
                let $init = &mut $crate::networks::Initializer::new(&context);
                $(let $field = $make?;)*
                Ok(Self { $config, context, $($field),* })
            }

            fn networks(&mut self) -> $crate::state_dict::StateDict<'_> {
                $crate::state_dict::StateDict::default()
                    $(.with(stringify!($field), &mut self.$field))*
            }
        }
    };
}
pub(crate) use networks;

/// A network with its optimizer; it is used like the network.
pub(super) struct TrainState<N> {
    pub network: N,
    pub adam: Adam,
}

impl<N: Weighted> TrainState<N> {
    pub fn new(network: N) -> Result<Self> {
        let adam = Adam::new(network.weights(), 0.0)?;
        Ok(Self { network, adam })
    }

    /// Makes the weights decay by this share of the learning rate in each step.
    pub fn decay_weights(&mut self, share: f32) -> Result<()> {
        self.adam = Adam::new(self.network.weights(), share)?;
        Ok(())
    }

    /// Moves the network down a loss `[]`. Returns the gradient's norm before clipping, `[]`.
    pub fn minimize(&mut self, loss: &Tensor, step: AdamStep) -> Result<Tensor> {
        self.apply_gradients(&Gradients::backward(loss)?, step)
    }

    /// Sets the step of [`Self::minimize_as_set`].
    pub fn set_step(&mut self, step: AdamStep) -> Result<()> {
        self.adam.set_step(step)
    }

    /// [`Self::minimize`] with the step that [`Self::set_step`] has set.
    pub fn minimize_as_set(&mut self, loss: &Tensor) -> Result<Tensor> {
        let gradient = Gradients::backward(loss)?.with_respect_to(self.network.weights())?;
        self.adam.apply(self.network.weights_mut(), &gradient)
    }

    /// [`Self::minimize`] with gradients that were computed before.
    pub fn apply_gradients(&mut self, gradients: &Gradients, step: AdamStep) -> Result<Tensor> {
        let gradient = gradients.with_respect_to(self.network.weights())?;
        self.adam.set_step(step)?;
        self.adam.apply(self.network.weights_mut(), &gradient)
    }

    /// Adds a target network, which `copy` makes.
    pub fn with_target(self, copy: impl FnOnce(&N) -> Result<N>) -> Result<WithTarget<N>> {
        let target = copy(&self.network)?;
        Ok(WithTarget { online: self, target })
    }
}

impl<N: Weighted> Stateful for TrainState<N> {
    fn add_to<'a>(&'a mut self, dict: &mut StateDict<'a>, name: &str) {
        let layout = self.network.weights().layout().clone();
        dict.adam(name.to_owned(), &mut self.adam, layout);
        dict.weights(name.to_owned(), self.network.weights_mut());
    }
}

impl<N> Deref for TrainState<N> {
    type Target = N;

    fn deref(&self) -> &N {
        &self.network
    }
}

/// A network with its optimizer and its target network, an exponential moving average (EMA).
pub(super) struct WithTarget<N> {
    online: TrainState<N>,
    pub target: N,
}

impl<N: Weighted> WithTarget<N> {
    /// Moves the target network toward the network: target = (1 − rate)·target + rate·network.
    pub fn soft_update(&mut self, rate: f32) -> Result<()> {
        self.target.soft_update(&self.online.network, rate)
    }
}

impl<N> Deref for WithTarget<N> {
    type Target = TrainState<N>;

    fn deref(&self) -> &TrainState<N> {
        &self.online
    }
}

impl<N> DerefMut for WithTarget<N> {
    fn deref_mut(&mut self) -> &mut TrainState<N> {
        &mut self.online
    }
}

impl<N: Weighted> Stateful for WithTarget<N> {
    fn add_to<'a>(&'a mut self, dict: &mut StateDict<'a>, name: &str) {
        self.online.add_to(dict, name);
        dict.weights(format!("target_{name}"), self.target.weights_mut());
    }
}

/// Initializes the networks of a run, each from its own random stream.
pub(super) struct Initializer<'a> {
    pub context: &'a Context,
    count: u64,
}

impl<'a> Initializer<'a> {
    pub fn new(context: &'a Context) -> Self {
        Self { context, count: 0 }
    }

    /// A network whose trainable weights have this layout.
    pub fn network<N: Weighted>(
        &mut self,
        layout: &Layout,
        network: impl FnOnce(Weights) -> N,
    ) -> Result<TrainState<N>> {
        let mut generator = stream(self.context.seed, Purpose::Weights, self.count);
        self.count += 1;
        let values = Weights::initial(layout, &mut generator, &self.context.device)?;
        TrainState::new(network(Weights::trainable(layout.clone(), &values)?))
    }

    pub fn ensemble(&mut self, shape: EnsembleShape) -> Result<TrainState<Ensemble>> {
        let precision = self.context.precision;
        self.network(&shape.layout(), |weights| Ensemble::new(shape, weights, precision))
    }

    /// A network with the weights of another and a new optimizer.
    pub fn copy(&self, other: &TrainState<Ensemble>) -> Result<TrainState<Ensemble>> {
        let (weights, shape) = (other.network.weights(), other.network.shape().clone());
        let weights = Weights::trainable(weights.layout().clone(), &weights.values().detach())?;
        TrainState::new(Ensemble::new(shape, weights, self.context.precision))
    }

    /// The shape of one network from [s, a] to a number.
    pub fn shape(&self, layers: &MlpConfig) -> EnsembleShape {
        EnsembleShape {
            members: 1,
            observation_dim: self.context.observation_dim(),
            action_dim: self.context.action_dim(),
            layers: layers.clone(),
            outputs: 1,
        }
    }

    /// Q_1 … Q_K with target networks.
    pub fn critics(&mut self, members: usize, layers: &MlpConfig) -> Result<WithTarget<Ensemble>> {
        let mut shape = self.shape(layers);
        shape.members = members;
        self.ensemble(shape)?.with_target(Ensemble::copy)
    }

    /// V(s).
    pub fn value(&mut self, layers: &MlpConfig) -> Result<TrainState<Ensemble>> {
        self.state_network(layers, 1)
    }

    /// A network from s to this number of outputs.
    pub fn state_network(
        &mut self,
        layers: &MlpConfig,
        outputs: usize,
    ) -> Result<TrainState<Ensemble>> {
        self.ensemble(EnsembleShape { action_dim: 0, outputs, ..self.shape(layers) })
    }

    /// Learned numbers `[n]` with these initial values.
    pub fn numbers(&self, name: &str, values: &[f32]) -> Result<TrainState<Weights>> {
        let spec = TensorSpec::new(name.to_owned(), &[values.len()], Init::Constant(0.0));
        let values = Tensor::from_slice(values, values.len(), &self.context.device)?;
        TrainState::new(Weights::trainable(Layout::new(vec![spec]), &values)?)
    }
}

impl TrainState<Ensemble> {
    /// Multiplies the weights of the last layer by a factor.
    pub fn scale_last_layer(mut self, factor: f64) -> Result<Self> {
        let last = format!("{}.", self.network.shape().layers.hidden.len());
        let weights = self.network.weights_mut();
        let mut tensors = weights.tensors("")?;
        tensors.retain(|name, _| name.starts_with(&last));
        let count = tensors.values().map(Tensor::elem_count).sum();
        weights.change(|values| {
            let start = values.elem_count() - count; // it lies at the end
            values.slice_set(&(values.narrow(0, start, count)? * factor)?, 0, start)
        })?;
        Ok(self)
    }
}
