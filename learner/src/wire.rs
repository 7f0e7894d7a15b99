//! Everything the learner declares on Zenoh, in one place. The callbacks only put messages into inboxes, and make connections
//! wait that send too many. They copy each message: as Zenoh hands it over, it keeps the whole buffer of 64 KiB that it was
//! received in.

mod flood;
mod tokens;
mod twin;

use std::sync::Arc;
use std::time::Duration;

use anyhow::anyhow;
use quad_protocol::{Name, keys};
use quad_service::Hint;
use zenoh::Session;
use zenoh::key_expr::KeyExpr;
use zenoh::liveliness::LivelinessToken;
use zenoh::pubsub::Subscriber;
use zenoh::query::{Query, Queryable};
use zenoh::sample::{Locality, Sample, SampleKind};

use self::flood::FloodGuard;
use crate::herald::Herald;
use crate::inbox::{Inbox, MOST_BYTES};
use crate::metrics::Metrics;
use crate::replies::{Asker, Question, Replies};
use crate::{hub, publisher};

/// How long the last answers may take, and then the session to close.
const LAST_ANSWERS: Duration = Duration::from_secs(1);
/// To send megabytes of weights takes as long as to read so many messages, or longer. So a connection gets ten at once, and in
/// the long run five a second; an evaluator needs one for each job at most.
const WEIGHTS: u32 = 40;

/// Which life of which run's learner this is.
#[derive(Clone, Debug)]
pub struct Life {
    /// The run.
    pub run: Name,
    /// Which start of its learner.
    pub incarnation: u64,
    /// Whether a router brings it all messages by one connection; else it listens itself.
    pub behind_router: bool,
}

/// The learner's declarations; dropping it undeclares them.
pub struct Wire {
    session: Session,
    replies: Replies,
    flood: Arc<FloodGuard>,
    _queryables: [Queryable<()>; 3],
    _progress: Subscriber<()>,
    _strays: Option<(Subscriber<()>, Subscriber<()>, Queryable<()>)>,
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
        let replies = Replies::start(metrics, hub)?;
        let flood = Arc::new(FloodGuard::new(metrics.held_back_seconds.clone()));
        // A router sends by one connection what many say. It must not be held back.
        if life.behind_router {
            flood.end();
        }
        let herald = Herald::start(&session, hub)?;
        publisher.send(publisher::Event::Online(herald.clone()));
        let follower = tokens::follower(&session, run, hub, metrics)?;
        hub.send(hub::Event::Online { herald, follower });

        let server = Server { session: &session, metrics, replies: &replies, flood: &flood };
        let queryables = [
            server.serve(keys::weights_at_any_step(run), WEIGHTS, publisher, publisher::Event::Query).await?,
            server.serve(keys::jobs(run), 1, hub, hub::Event::Job).await?,
            server.serve(keys::scores(run), 1, hub, hub::Event::Report).await?,
        ];

        let (inbox, counted, guard) = (hub.clone(), metrics.clone(), flood.clone());
        let progress = session
            .declare_subscriber(keys::all_progress(run))
            .callback(move |sample: Sample| {
                guard.message();
                let bytes = sample.payload().len();
                if bytes > MOST_BYTES {
                    counted.reject("oversized");
                } else if inbox.offer(hub::Event::Progress(sample.payload().to_bytes().into_owned()), bytes).is_err() {
                    counted.reject("busy");
                }
            })
            .await
            .map_err(zenoh_error)?;
        let strays = if life.behind_router { None } else { Some(server.strays(run).await?) };

        ready()?;
        let token = session.liveliness().declare_token(keys::live_learner(run, life.incarnation)).await;
        let token = token.map_err(zenoh_error)?;
        // Two that start at once may both have seen nobody.
        twin::watch(&session, &life, hub).await?;
        Ok(Self {
            session,
            replies,
            flood,
            _queryables: queryables,
            _progress: progress,
            _strays: strays,
            _token: token,
        })
    }

    /// Closes the session; answers that were sent before are still delivered to whoever reads them.
    pub async fn close(self) -> anyhow::Result<()> {
        self.flood.end();
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
    flood: &'a Arc<FloodGuard>,
}

impl Server<'_> {
    /// Takes in questions, each of which counts as so many messages.
    async fn serve<E: Send + 'static>(
        &self,
        key: String,
        counts: u32,
        inbox: &Inbox<E>,
        event: fn(Question) -> E,
    ) -> anyhow::Result<Queryable<()>> {
        let (inbox, metrics, replies) = (inbox.clone(), self.metrics.clone(), self.replies.clone());
        let guard = self.flood.clone();
        let callback = move |query: Query| {
            guard.messages(counts);
            let question = Question::new(query, &replies);
            let bytes = question.bytes();
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

    /// Takes what nobody has a reason to send here: counts it, and holds back whoever sends much of it.
    async fn strays(&self, run: &Name) -> anyhow::Result<(Subscriber<()>, Subscriber<()>, Queryable<()>)> {
        let served = [keys::weights_at_any_step(run), keys::jobs(run), keys::scores(run), keys::all_progress(run)];
        let served = served.map(KeyExpr::new).into_iter().collect::<Result<Vec<_>, _>>().map_err(zenoh_error)?;
        let (guard, counted) = (self.flood.clone(), self.metrics.clone());
        let stray = move |key: &KeyExpr<'_>| {
            let stray = !served.iter().any(|served| served.intersects(key));
            if stray {
                guard.message();
                counted.reject("key");
            }
            stray
        };
        let (published, asked, replies) = (stray.clone(), stray, self.replies.clone());
        let published = move |sample: Sample| {
            published(sample.key_expr());
        };
        let asked = move |query: Query| {
            if asked(query.key_expr()) {
                Question::new(query, &replies);
            }
        };
        // An evaluator has one for each run that it works for. They are held back, but nothing is wrong with them. Who leaves has
        // come before; and all of a connection's leave at its end, not in its task.
        let guard = self.flood.clone();
        let token = move |sample: Sample| {
            if sample.kind() == SampleKind::Put {
                guard.message();
            }
        };
        let remote = Locality::Remote;
        let subscriber = self.session.declare_subscriber("**").allowed_origin(remote).callback(published).await;
        let queryable = self.session.declare_queryable("**").allowed_origin(remote).callback(asked).await;
        let tokens = self.session.liveliness().declare_subscriber("**").callback(token).await;
        Ok((subscriber.map_err(zenoh_error)?, tokens.map_err(zenoh_error)?, queryable.map_err(zenoh_error)?))
    }
}

fn zenoh_error(error: zenoh::Error) -> anyhow::Error {
    anyhow!(error)
}
