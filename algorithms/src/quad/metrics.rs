//! What an update of QUAD measures.

use crate::algorithm::Metric;

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
        name: "nu_squared",
        label: "",
        help: "ν̂²: moving average of the variance over the batch of the critics' mean alignment (Eq. 21–23). 0 without guidance.",
    },
    Metric { name: "critic_gradient_norm", label: "", help: "Global norm of the critics' gradient before clipping." },
    Metric { name: "actor_gradient_norm", label: "", help: "Global norm of the actor's gradient before clipping." },
    Metric { name: "learning_rate", label: "", help: "The actor's learning rate; falls to 0 along a cosine." },
    Metric {
        name: "delta_share",
        label: "",
        help: "Share of the batch, 0 to 1, in which δ is more than a hundredth of the denominator of λ (Eq. 24), so that it decides λ and not the critics. 0 with guidance dac and constant, and, like all that follow, without guidance.",
    },
    Metric {
        name: "lambda_mean",
        label: "λ",
        help: "Mean over the batch of λ = ν̂²/(ν̂² + σ²/τ + δ) (Eq. 24), in (0, 1]: how far the critics' gradients are trusted. With guidance constant, mean or shuffled it is what they have in its place, as in all metrics of λ; 1 with dac.",
    },
    Metric { name: "lambda_quantile_10", label: "", help: "A tenth of the batch has a λ below this." },
    Metric { name: "lambda_quantile_50", label: "", help: "Median of λ over the batch." },
    Metric { name: "lambda_quantile_90", label: "", help: "A tenth of the batch has a λ above this." },
    Metric {
        name: "lambda_fifth_1",
        label: "",
        help: "Mean of λ over the samples whose denoising step t is in the first fifth of 1…T, the least noisy; with T = 5, as in the paper, it is t = 1. Of all samples where the batch has none of it.",
    },
    Metric { name: "lambda_fifth_2", label: "", help: "The same of t in the second fifth." },
    Metric { name: "lambda_fifth_3", label: "", help: "The same of t in the third fifth." },
    Metric { name: "lambda_fifth_4", label: "", help: "The same of t in the fourth fifth." },
    Metric { name: "lambda_fifth_5", label: "", help: "The same of t in the last fifth, the noisiest." },
    Metric {
        name: "lambda_above_99_share",
        label: "",
        help: "Share of the batch, 0 to 1, whose λ is above 0.99: there QUAD is DAC to within 1 %.",
    },
    Metric {
        name: "variance_ratio",
        label: "",
        help: "Mean over the batch of σ²/(ν̂² + δ), which is what λ falls with: the critics' disagreement on the alignment (Eq. 22) over how much it varies between samples.",
    },
    Metric {
        name: "guidance_cosine",
        label: "",
        help: "Mean over the batch of the cosine between the gradients of guidance, ḡ, and of behaviour cloning, ε_θ − ε, with respect to ε_θ: 1 where both pull in one direction, −1 where they pull against each other.",
    },
];
