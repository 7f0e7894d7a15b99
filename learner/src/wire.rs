//! Everything the learner declares on Zenoh, in one place. The callbacks only put messages into inboxes.

mod twin;

use std::time::Duration;

use anyhow::anyhow;
use quad_protocol::{Name, keys};
use quad_service::Hint;
use zenoh::Session;
use zenoh::liveliness::LivelinessToken;
use zenoh::pubsub::Subscriber;
use zenoh::qos::CongestionControl;
use zenoh::query::{Query, Queryable};
use zenoh::sample::Sample;

use crate::inbox::{Inbox, MOST_BYTES};
use crate::metrics::Metrics;
use crate::replies::{Asker, Question, Replies};
use crate::{hub, publisher};

/// How long the last answers may take, and then the session to close.
const LAST_ANSWERS: Duration = Duration::from_secs(1);

/// Which life of which run's learner this is.
#[derive(Clone, Debug)]
pub struct Life {
    /// The run.
    pub run: Name,
    /// Which start of its learner.
    pub incarnation: u64,
}

/// The learner's declarations; dropping it undeclares them.
pub struct Wire {
    session: Session,
    replies: Replies,
    _queryables: [Queryable<()>; 3],
    _subscribers: [Subscriber<()>; 3],
    _token: LivelinessToken,
}

impl Wire {
    /// Declares the queryables, then the subscribers, and last the learner's liveliness token, so that an evaluator that
    /// sees the token finds everything else in place. Calls `ready` just before the token.
    ///
    /// # Errors
    ///
    /// Another learner has the run's name, which takes some seconds to be sure of; or Zenoh fails.
    pub async fn declare(
        session: Session,
        life: Life,
        hub: &Inbox<hub::Event>,
        publisher: &Inbox<publisher::Event>,
        metrics: &Metrics,
        ready: impl FnOnce() -> anyhow::Result<()>,
    ) -> anyhow::Result<Self> {
        twin::wait_until_gone(&session, &life).await.hint(twin::HINT)?;
        let run = &life.run;
        let replies = Replies::start(metrics)?;
        // A slow subscriber loses a snapshot, which it can ask for later, instead of delaying the other subscribers.
        let weights = session.declare_publisher(keys::weights(run)).congestion_control(CongestionControl::Drop).await;
        publisher.send(publisher::Event::Online(weights.map_err(zenoh_error)?));
        hub.send(hub::Event::Online(session.clone()));

        let server = Server { session: &session, metrics, replies: &replies };
        let queryables = [
            server.serve(keys::weights_at_any_step(run), publisher, publisher::Event::Query).await?,
            server.serve(keys::jobs(run), hub, hub::Event::Job).await?,
            server.serve(keys::scores(run), hub, hub::Event::Report).await?,
        ];

        let (inbox, counted) = (hub.clone(), metrics.clone());
        let progress = session
            .declare_subscriber(keys::all_progress(run))
            .callback(move |sample: Sample| {
                let bytes = sample.payload().len();
                if bytes > MOST_BYTES {
                    counted.reject("oversized");
                } else if inbox.offer(hub::Event::Progress(sample), bytes).is_err() {
                    counted.reject("busy");
                }
            })
            .await
            .map_err(zenoh_error)?;
        let (inbox, counted) = (hub.clone(), metrics.clone());
        let evaluators = session
            .liveliness()
            .declare_subscriber(keys::all_evaluators(run))
            .history(true)
            .callback(move |sample| {
                // What is lost here is a name in the display, or a job that waits for the end of its lease.
                if inbox.offer_change(hub::Event::Liveliness(sample)).is_err() {
                    counted.reject("busy");
                }
            })
            .await
            .map_err(zenoh_error)?;

        ready()?;
        let token = session.liveliness().declare_token(keys::live_learner(run, life.incarnation)).await;
        let token = token.map_err(zenoh_error)?;
        // Two that start at once may both have seen nobody.
        let twins = twin::watch(&session, &life, hub).await?;
        Ok(Self {
            session,
            replies,
            _queryables: queryables,
            _subscribers: [progress, evaluators, twins],
            _token: token,
        })
    }

    /// Closes the session; answers that were sent before are still delivered to whoever reads them.
    pub async fn close(self) -> anyhow::Result<()> {
        let replies = self.replies.clone();
        tokio::task::spawn_blocking(move || replies.finish(LAST_ANSWERS)).await?;
        self.session.close().await.map_err(zenoh_error)
    }
}

/// What every queryable needs.
struct Server<'a> {
    session: &'a Session,
    metrics: &'a Metrics,
    replies: &'a Replies,
}

impl Server<'_> {
    async fn serve<E: Send + 'static>(
        &self,
        key: String,
        inbox: &Inbox<E>,
        event: fn(Question) -> E,
    ) -> anyhow::Result<Queryable<()>> {
        let (inbox, metrics, replies) = (inbox.clone(), self.metrics.clone(), self.replies.clone());
        let callback = move |query: Query| {
            let question = replies.question(query);
            let bytes = question.payload().map_or(0, |payload| payload.len());
            if bytes > MOST_BYTES {
                metrics.reject("oversized");
                question.answer(Asker::Stranger, Err("the message is too large".to_owned()));
            } else if inbox.offer(event(question), bytes).is_err() {
                // Without an answer the evaluator asks again.
                metrics.reject("busy");
            }
        };
        // Complete: whoever asks for the best answer only asks here, too.
        let declared = self.session.declare_queryable(key).complete(true).callback(callback).await;
        declared.map_err(zenoh_error)
    }
}

fn zenoh_error(error: zenoh::Error) -> anyhow::Error {
    anyhow!(error)
}
