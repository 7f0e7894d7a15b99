//! `learner page`: serves the page of all runs until a signal.

use anyhow::anyhow;
use quad_runtime::{Health, Hint, LEAVE_WITHIN, ListenError, serve_metrics, shutdown_signal};
use tracing::info;

use crate::cli::PageArgs;
use crate::page::routes;

pub fn show(args: &PageArgs) -> anyhow::Result<()> {
    let folder = args.runs.display();
    if !args.runs.is_dir() {
        return Err(anyhow!("there is no folder {folder}")).hint("name one: learner page DIR");
    }
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    runtime.block_on(async {
        let page = routes(args.runs.clone(), None);
        let server =
            serve_metrics(args.http, &args.http_hosts, Default::default(), Health::default(), page);
        let server = server.await;
        let server = server.hint_of(ListenError::hint)?;
        info!("page: http://{}/ shows the runs in {folder}; Ctrl-C ends it", server.address);
        shutdown_signal(LEAVE_WITHIN).await;
        Ok(())
    })
}
