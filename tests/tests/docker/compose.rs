//! A system of containers, and what can be done to one of them.

use std::process::{Command, Stdio};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::thread::sleep;
use std::time::Duration;

use quad_tests::eventually;

use crate::images::{are_there, repository};

/// How long anything but training is waited for.
pub const PATIENCE: Duration = Duration::from_secs(240);
/// How long a run may take.
pub const TRAINING: Duration = Duration::from_secs(1800);
/// Between two questions to Docker, each of which is a program of its own.
const PAUSE: Duration = Duration::from_millis(300);

/// What makes a gradient step and an episode so light that a run of many evaluations takes seconds.
pub const LIGHT: &str = "--agent actor.hidden=[64,64,64] --agent critic.hidden=[64,64,64] --agent critics=2 \
                         --agent diffusion_steps=2 --agent candidates=5 --set batch_size=16 --episodes 4 \
                         --checkpoint-seconds 1";

/// A Compose project of its own, on ports that Docker chooses; gone with its volumes when dropped. There is one at a time,
/// so that each has the machine to itself.
pub struct Compose {
    project: String,
    variables: Vec<(&'static str, String)>,
    _alone: MutexGuard<'static, ()>,
}

impl Compose {
    /// Nothing runs yet. `name` is also the run's, and `arguments` are the learner's. `None` if the test is to be skipped.
    pub fn project(name: &str, arguments: &str) -> Option<Compose> {
        static ONE: Mutex<()> = Mutex::new(());
        let alone = ONE.lock().unwrap_or_else(PoisonError::into_inner);
        let variables = [
            ("COMPOSE_FILE", "docker-compose.yml"),
            ("QUAD_ROUTER_PORT", "0"),
            ("QUAD_PROMETHEUS_PORT", "0"),
            ("QUAD_GRAFANA_PULL", "never"),
            ("QUAD_RUN", name),
            ("QUAD_COLLECT_ARGS", "--transitions 5000"),
            ("QUAD_TRAIN_ARGS", arguments),
        ];
        let variables = variables.map(|(variable, value)| (variable, value.to_owned())).to_vec();
        let project = format!("quad-{name}-{}", std::process::id());
        are_there().then_some(Compose { project, variables, _alone: alone })
    }

    /// Sets one of the variables of docker-compose.yml.
    pub fn set(&mut self, variable: &'static str, value: &str) {
        self.variables.retain(|(earlier, _)| *earlier != variable);
        self.variables.push((variable, value.to_owned()));
    }

    fn command(&self, arguments: &[&str]) -> Command {
        let mut command = Command::new("docker");
        command.current_dir(repository()).args(["compose", "--progress", "quiet", "--project-name", &self.project]);
        command.args(arguments).envs(self.variables.iter().map(|(variable, value)| (variable, value)));
        command.stdin(Stdio::null()).stderr(Stdio::inherit());
        command
    }

    /// `docker compose …`, which must succeed; gives what it prints.
    pub fn run(&self, arguments: &[&str]) -> String {
        output(self.command(arguments))
    }

    /// The containers of a service, whatever their state.
    pub fn containers(&self, service: &str) -> Vec<String> {
        self.run(&["ps", "--all", "--quiet", service]).lines().map(str::to_owned).collect()
    }

    /// The only container of a service.
    pub fn container(&self, service: &str) -> String {
        let containers = self.containers(service);
        assert_eq!(containers.len(), 1, "containers of {service}");
        containers[0].clone()
    }

    /// The private network that all of them share.
    pub fn network(&self) -> String {
        format!("{}_default", self.project)
    }

    /// Waits until the run is complete, and lets `learner verify` look at it.
    pub fn assert_run_is_complete(&self, name: &str) -> String {
        let learner = self.container("learner");
        eventually("the learner ended", TRAINING, || {
            sleep(PAUSE);
            has_ended(&learner).then_some(())
        });
        assert_eq!(inspect(&learner, "{{.State.ExitCode}}"), "0", "the learner's exit code");
        self.learner(&format!("learner verify /runs/{name}")).trim().to_owned()
    }

    /// What a command prints in a container of the learner's image with its volumes.
    pub fn learner(&self, script: &str) -> String {
        self.run(&["run", "--rm", "--no-deps", "--entrypoint", "bash", "learner", "-c", script])
    }
}

impl Drop for Compose {
    fn drop(&mut self) {
        if std::thread::panicking() {
            self.command(&["logs", "--tail", "30"]).status().ok();
        }
        self.command(&["down", "--volumes", "--timeout", "5"]).status().ok();
    }
}

/// `docker …`; whether it succeeded.
pub fn succeeds(arguments: &[&str]) -> bool {
    Command::new("docker").args(arguments).stdout(Stdio::null()).status().expect("docker was found before").success()
}

/// `docker …`, which must succeed; gives what it prints.
pub fn docker(arguments: &[&str]) -> String {
    let mut command = Command::new("docker");
    command.args(arguments).stderr(Stdio::inherit());
    output(command)
}

/// One fact about a container.
pub fn inspect(container: &str, format: &str) -> String {
    docker(&["inspect", "--format", format, container]).trim().to_owned()
}

/// Whether a container has ended for good. (One that crashed and is to be started again has not.)
pub fn has_ended(container: &str) -> bool {
    inspect(container, "{{.State.Status}}") == "exited"
}

/// Everything that a container has printed, over all its starts.
pub fn logs(container: &str) -> String {
    let output = Command::new("docker").args(["logs", container]).output().expect("docker was found before");
    String::from_utf8_lossy(&[output.stdout, output.stderr].concat()).into_owned()
}

/// Waits until a container has printed `text` so often.
pub fn wait_for_log(container: &str, text: &str, times: usize) {
    eventually(&format!("{text:?} {times} times in the log"), PATIENCE, || {
        sleep(PAUSE);
        (logs(container).matches(text).count() >= times).then_some(())
    });
}

/// Kills a container's process and waits until it is there again by itself. If it had ended before, does nothing, and is
/// false.
///
/// `docker kill` would be an order, after which the engine starts nothing again, and from inside, a container's first
/// process cannot be killed: it takes a process that sees them all.
pub fn crash(container: &str) -> bool {
    let (process, start) = (inspect(container, "{{.State.Pid}}"), inspect(container, "{{.State.StartedAt}}"));
    let kill = format!("kill -KILL {process}");
    let outside = ["run", "--rm", "--pid", "host", "--network", "none", "--user", "0", "--entrypoint", "bash"];
    let killed = process != "0" && succeeds(&[&outside[..], &["quad/evaluator", "-c", &kill]].concat());
    killed && {
        eventually("the container is started again", PATIENCE, || {
            let state = inspect(container, "{{.State.Status}} {{.State.StartedAt}}");
            state.strip_prefix("running ").filter(|again| *again != start).map(|_| true)
        })
    }
}

fn output(mut command: Command) -> String {
    let output = command.output().expect("docker was found before");
    let printed = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(output.status.success(), "{command:?} ended with {}:\n{printed}", output.status);
    printed
}
