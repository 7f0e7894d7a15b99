//! Everything that the learner declares on Zenoh. The callbacks run on Zenoh's threads and must not wait, which would delay
//! their whole connection: they pass queries to our threads, and record messages that need no answer.

use quad_protocol::keys;
use tracing::debug;
use zenoh::Session;
use zenoh::liveliness::LivelinessToken;
use zenoh::pubsub::Subscriber;
use zenoh::query::{Query, Queryable};

use super::duplicate::{self, Life};
use super::requests::Request;
use super::services::Services;

/// The learner's declarations; dropping it undeclares them.
pub(super) struct Wire {
    session: Session,
    _queryables: [Queryable<()>; 3],
    _subscribers: [Subscriber<()>; 2],
    _token: LivelinessToken,
}

impl Wire {
    /// Declares the queryables, then the subscribers, and last the learner's liveliness token, so that an evaluator that sees
    /// the token finds everything else ready.
    ///
    /// # Errors
    ///
    /// Another learner has the run's name, which takes some seconds to find out; or Zenoh fails.
    pub async fn declare(session: Session, life: &Life, services: &Services) -> anyhow::Result<Self> {
        duplicate::wait_until_gone(&session, life).await?;
        let run = &life.run;
        services.weights.online(&session);
        let queryables = [
            serve(&session, keys::weights_at_any_step(run), services, Services::weights).await?,
            serve(&session, keys::jobs(run), services, Services::job).await?,
            serve(&session, keys::scores(run), services, Services::report).await?,
        ];
        let told = services.clone();
        let progress = session.declare_subscriber(keys::all_progress(run));
        let progress =
            progress.callback(move |sample| told.progress(&sample)).await.map_err(anyhow::Error::from_boxed)?;
        let told = services.clone();
        let evaluators = session.liveliness().declare_subscriber(keys::all_evaluators(run)).history(true);
        let evaluators =
            evaluators.callback(move |token| told.evaluator(&token)).await.map_err(anyhow::Error::from_boxed)?;
        let token = session.liveliness().declare_token(keys::live_learner(run, life.incarnation)).await;
        let token = token.map_err(anyhow::Error::from_boxed)?;
        // Of two learners that start at once, neither may have seen the other.
        duplicate::watch(&session, life, &services.events).await?;
        Ok(Self { session, _queryables: queryables, _subscribers: [progress, evaluators], _token: token })
    }

    /// Closes the session; Zenoh still delivers earlier answers.
    pub async fn close(self) {
        if let Err(error) = self.session.close().await {
            debug!(%error, "the session did not close");
        }
    }
}

async fn serve(
    session: &Session,
    key: String,
    services: &Services,
    answer: fn(&Services, Request),
) -> anyhow::Result<Queryable<()>> {
    let services = services.clone();
    let callback = move |query: Query| answer(&services, Request::new(query));
    // Complete: an evaluator that asks only for the best answer asks here, too.
    session.declare_queryable(key).complete(true).callback(callback).await.map_err(anyhow::Error::from_boxed)
}
