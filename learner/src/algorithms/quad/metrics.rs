//! What an update of QUAD measures.

use crate::algorithms::algorithm::Metric;

/// In the order of the values that an update gives.
pub(super) const METRICS: &[Metric] = &[
    Metric {
        name: "q_mean",
        label: "",
        help: "Mean over the batch of the critics' target y (Eq. 20). A value that grows without end is overestimation.",
    },
    Metric {
        name: "critic_loss",
        label: "critic loss",
        help: "Mean over critics and batch of (y − Q_k(s, a))² with y = r + γ·mask·Q_LCB(s', a'), Q_LCB = mean_k Q̂_k − ρ·std_k Q̂_k (Eq. 20).",
    },
    Metric {
        name: "bc_loss",
        label: "BC loss",
        help: "Mean over batch and dimensions of (ε − ε_θ(a^t, s, t))², the behaviour-cloning term of Eq. 19 before η. 1 is a predictor that always says 0; a policy that knows the data lies well below.",
    },
    Metric {
        name: "actor_loss",
        label: "",
        help: "Eq. 19: η·(BC loss) + mean of λ·w(t)·ε_θ·ḡ, where ḡ is the Q-gradient (Eq. 10) over the mean of |Q̂_k(s, a)| and w(t) = √(1 − ᾱ_t).",
    },
    Metric {
        name: "eta",
        label: "η",
        help: "Strength η of behaviour cloning (Eq. 19). With a threshold b it rises while the BC loss is above b and falls while it is below; without one, or without guidance, it is constant.",
    },
    Metric {
        name: "lambda_mean",
        label: "λ",
        help: "Mean over the batch of λ = ν̂²/(ν̂² + σ²/τ + δ) (Eq. 24), in (0, 1]: how far the critics' gradients are trusted. 1 with guidance dac, 0 with guidance none.",
    },
    Metric {
        name: "delta_share",
        label: "",
        help: "Share of the batch, 0 to 1, in which δ is more than a hundredth of the denominator of λ (Eq. 24), so that it decides λ and not the critics. 0 unless guidance is quad.",
    },
    Metric {
        name: "nu_squared",
        label: "",
        help: "ν̂²: moving average of the variance over the batch of the critics' mean alignment (Eq. 21–23). 0 without guidance.",
    },
    Metric { name: "critic_gradient_norm", label: "", help: "Global norm of the critics' gradient before clipping." },
    Metric { name: "actor_gradient_norm", label: "", help: "Global norm of the actor's gradient before clipping." },
    Metric { name: "learning_rate", label: "", help: "The actor's learning rate; falls to 0 along a cosine." },
];
