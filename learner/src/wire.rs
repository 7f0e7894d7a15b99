//! Everything the learner declares on Zenoh, in one place. The callbacks only put messages into inboxes.

use anyhow::anyhow;
use quad_protocol::{Name, keys};
use zenoh::liveliness::LivelinessToken;
use zenoh::pubsub::Subscriber;
use zenoh::qos::CongestionControl;
use zenoh::query::{Query, Queryable};
use zenoh::sample::Sample;
use zenoh::{Session, Wait};

use crate::inbox::{Inbox, MOST_BYTES};
use crate::metrics::Metrics;
use crate::{hub, publisher};

/// The learner's declarations; dropping it undeclares them.
pub struct Wire {
    session: Session,
    _queryables: [Queryable<()>; 3],
    _subscribers: [Subscriber<()>; 2],
    _token: LivelinessToken,
}

impl Wire {
    /// Declares the queryables, then the subscribers, and last the learner's liveliness token, so that an evaluator that
    /// sees the token finds everything else in place. Calls `ready` just before the token.
    pub async fn declare(
        session: Session,
        run: &Name,
        hub: &Inbox<hub::Event>,
        publisher: &Inbox<publisher::Event>,
        metrics: &Metrics,
        ready: impl FnOnce() -> anyhow::Result<()>,
    ) -> anyhow::Result<Self> {
        // A slow subscriber loses a snapshot, which it can ask for later, instead of delaying the other subscribers.
        let weights = session.declare_publisher(keys::weights(run)).congestion_control(CongestionControl::Drop).await;
        publisher.send(publisher::Event::Online(weights.map_err(zenoh_error)?));
        hub.send(hub::Event::Online(session.clone()));

        let queryables = [
            serve(&session, keys::weights_at_any_step(run), publisher, publisher::Event::Query, metrics).await?,
            serve(&session, keys::jobs(run), hub, hub::Event::Claim, metrics).await?,
            serve(&session, keys::scores(run), hub, hub::Event::Report, metrics).await?,
        ];

        let (inbox, counted) = (hub.clone(), metrics.clone());
        let progress = session
            .declare_subscriber(keys::all_progress(run))
            .callback(move |sample: Sample| {
                if sample.payload().len() > MOST_BYTES {
                    counted.reject("oversized");
                } else if inbox.offer(hub::Event::Progress(sample)).is_err() {
                    counted.reject("busy");
                }
            })
            .await
            .map_err(zenoh_error)?;
        let inbox = hub.clone();
        let evaluators = session
            .liveliness()
            .declare_subscriber(keys::all_evaluators(run))
            .history(true)
            .callback(move |sample| inbox.send(hub::Event::Liveliness(sample)))
            .await
            .map_err(zenoh_error)?;

        ready()?;
        let token = session.liveliness().declare_token(keys::live_learner(run)).await.map_err(zenoh_error)?;
        Ok(Self { session, _queryables: queryables, _subscribers: [progress, evaluators], _token: token })
    }

    /// Closes the session; answers that were sent before are still delivered.
    pub async fn close(self) -> anyhow::Result<()> {
        self.session.close().await.map_err(zenoh_error)
    }
}

async fn serve<E: Send + 'static>(
    session: &Session,
    key: String,
    inbox: &Inbox<E>,
    event: fn(Query) -> E,
    metrics: &Metrics,
) -> anyhow::Result<Queryable<()>> {
    let (inbox, metrics) = (inbox.clone(), metrics.clone());
    let callback = move |query: Query| {
        if query.payload().is_some_and(|payload| payload.len() > MOST_BYTES) {
            metrics.reject("oversized");
            query.reply_err("the message is too large").wait().ok();
        } else if inbox.offer(event(query)).is_err() {
            // The query is dropped, which ends it without an answer: the evaluator asks again.
            metrics.reject("busy");
        }
    };
    session.declare_queryable(key).callback(callback).await.map_err(zenoh_error)
}

fn zenoh_error(error: zenoh::Error) -> anyhow::Error {
    anyhow!(error)
}
