//! Draws poses: the model with colors, a floor and a light, seen by a camera.

use mujoco_rs::wrappers::mj_data::MjData;
use mujoco_rs::wrappers::mj_model::{MjModel, MjtGeom, MjtGeomBase, MjtObjBase};
use mujoco_rs::wrappers::mj_rendering::{MjrContext, MjrRectangle, MjtFont, MjtGridPos};
use mujoco_rs::wrappers::mj_visualization::{
    MjtRndFlag, MjvCamera, MjvOption, MjvPerturb, MjvScene,
};
use quad_dataset::EnvironmentSpec;

use super::episode::{Episode, Pose};
use super::gl::Gl;
use super::output::Layout;
use super::picture::Picture;
use crate::sim::{self, EnvironmentError};

/// Parts that only a camera sees, which the simulation's model leaves out. The light follows the
/// robot.
const LOOKS: &str = r#"
  <statistic extent="4"/>
  <visual>
    <global offwidth="{width}" offheight="{height}"/>
    <headlight ambient="0.35 0.35 0.35" diffuse="0.35 0.35 0.35" specular="0 0 0"/>
    <quality shadowsize="1024"/>
    <rgba haze="0.9 0.93 0.96 1"/>
  </visual>
  <asset>
    <texture type="skybox" builtin="gradient" rgb1="0.9 0.93 0.96" rgb2="0.62 0.73 0.85" width="64" height="384"/>
    <texture name="floor" type="2d" builtin="checker" rgb1="0.75 0.78 0.8" rgb2="0.6 0.64 0.67" width="256" height="256"/>
    <material name="floor" texture="floor" texrepeat="1 1" texuniform="true" specular="0" shininess="0"/>
  </asset>
  <worldbody>
    <light directional="true" mode="trackcom" pos="0 -1 4" dir="0.2 0.3 -1" diffuse="0.5 0.5 0.5" specular="0 0 0"/>"#;
/// A robot's first body has the first color, its last the second, so that crossing legs differ.
const ROBOT: [[f32; 3]; 2] = [[0.93, 0.49, 0.15], [0.16, 0.38, 0.66]];
const WALL: [f32; 4] = [0.8, 0.7, 0.55, 1.0];
const GOAL: [f32; 4] = [0.85, 0.15, 0.2, 0.6];
/// Radius of the ball at a goal, meters.
const GOAL_RADIUS: f64 = 0.5;
/// Side of a wall, meters.
const CELL: f64 = 4.0;
/// Space in a scene for geometries beyond the model's: the goal, and what MuJoCo adds.
const MORE: usize = 100;
/// The largest vertical angle of a free camera is 45°: at this many times its height, an object is
/// fully visible.
const WHOLE: f64 = 1.25;
/// The share of a view's height that the caption takes.
const CAPTION: f64 = 0.2;

/// Draws the films of one environment.
pub struct Stage {
    // Dropped in this order: MuJoCo must free its OpenGL objects before the context ends.
    context: MjrContext,
    scene: MjvScene,
    data: MjData<Box<MjModel>>,
    camera: MjvCamera,
    layout: Layout,
    _gl: Gl,
}

impl Stage {
    /// Builds the stage of an environment, for pictures of several episodes.
    ///
    /// # Errors
    /// There is no OpenGL, or MuJoCo fails.
    pub fn new(spec: &EnvironmentSpec, layout: Layout, episodes: usize) -> anyhow::Result<Self> {
        let gl = Gl::new()?;
        let model = Box::new(model(spec, layout.size(episodes))?);
        let camera = camera(&model, layout.aspect());
        // SAFETY: the context of `gl` is current on this thread, and outlives what is made here.
        let mut context = unsafe { MjrContext::new(&model) };
        context.offscreen();
        let mut scene = MjvScene::new(&model, model.geom_size().len() + MORE);
        // MuJoCo draws shadows only around one robot; shadows of a whole maze would be in pieces.
        scene.flags_mut()[MjtRndFlag::mjRND_SHADOW as usize] = u8::from(camera.trackbodyid >= 0);
        let data = MjData::try_new(model)
            .map_err(|error| EnvironmentError::Allocation(error.to_string()))?;
        Ok(Self { context, scene, data, camera, layout, _gl: gl })
    }

    /// The picture of all episodes after `steps` steps.
    ///
    /// # Errors
    /// The pixels cannot be read.
    pub fn draw(&mut self, episodes: &[Episode], steps: usize) -> anyhow::Result<Picture> {
        for (place, episode) in episodes.iter().enumerate() {
            let [left, bottom, width, height] =
                self.layout.view(place, episodes.len()).map(|pixels| pixels as i32);
            let view = MjrRectangle::new(left, bottom, width, height);
            self.pose(episode.pose(steps));
            self.scene.render(&view, &self.context);
            let (font, corner) = (MjtFont::mjFONT_NORMAL, MjtGridPos::mjGRID_TOPLEFT);
            let [left, right] = episode.caption(steps);
            self.context.overlay(font, corner, view, &left, Some(&right));
        }
        let (width, height) = self.layout.size(episodes.len());
        let mut rgb = vec![0; width * height * 3];
        self.context.read_pixels(
            Some(&mut rgb),
            None,
            &MjrRectangle::new(0, 0, width as i32, height as i32),
        )?;
        Ok(Picture { width, rgb }.flipped())
    }

    fn pose(&mut self, pose: &Pose) {
        self.data.qpos_mut().copy_from_slice(&pose.qpos);
        self.data.forward();
        self.scene.update(
            &mut self.data,
            &MjvOption::default(),
            &MjvPerturb::default(),
            &mut self.camera,
        );
        if let Some([x, y]) = pose.goal {
            let (size, at) = ([GOAL_RADIUS; 3], [x, y, GOAL_RADIUS]);
            // SAFETY: it has no material, texture or object, and there is space for it.
            unsafe {
                self.scene.create_geom(
                    MjtGeom::mjGEOM_SPHERE,
                    Some(size),
                    Some(at),
                    None,
                    Some(GOAL),
                )
            };
        }
    }
}

/// The model of an environment with the parts that only a camera sees, for pictures of a size
/// (width, height).
fn model(spec: &EnvironmentSpec, (width, height): (usize, usize)) -> anyhow::Result<MjModel> {
    let looks =
        LOOKS.replace("{width}", &width.to_string()).replace("{height}", &height.to_string());
    let mjcf = sim::mjcf(spec).replacen("<worldbody>", &looks, 1);
    let mjcf = mjcf.replacen(r#"<geom name="floor""#, r#"<geom name="floor" material="floor""#, 1);
    let mut model = MjModel::from_xml_string(&mjcf)?;
    paint(&mut model);
    Ok(model)
}

/// Colors robot and walls, and draws the floor without end, as it is in the simulation.
fn paint(model: &mut MjModel) {
    let bodies = model.geom_bodyid().to_vec();
    let last = bodies.iter().copied().max().unwrap_or(1);
    for (geom, body) in bodies.into_iter().enumerate() {
        let share = (body - 1) as f32 / (last - 1).max(1) as f32;
        let [red, green, blue] =
            [0, 1, 2].map(|i| ROBOT[0][i] + share * (ROBOT[1][i] - ROBOT[0][i]));
        model.geom_rgba_mut()[geom] = if body == 0 { WALL } else { [red, green, blue, 1.0] };
    }
    if let Some(floor) = model.name_to_id(MjtObjBase::mjOBJ_GEOM, "floor") {
        model.geom_size_mut()[floor] = [0.0, 0.0, 1.0];
        model.geom_rgba_mut()[floor] = [1.0; 4];
    }
}

/// Beside the robot, moving with it; in a maze, above all walls. `aspect` is a view's width over
/// its height.
fn camera(model: &MjModel, aspect: f64) -> MjvCamera {
    let walls: Vec<[f64; 3]> = (0..model.geom_size().len())
        .filter(|&geom| {
            model.geom_bodyid()[geom] == 0 && model.geom_type()[geom] == MjtGeomBase::mjGEOM_BOX
        })
        .map(|geom| model.geom_pos()[geom])
        .collect();
    let torso = model.name_to_id(MjtObjBase::mjOBJ_BODY, "torso").unwrap_or(1);
    let beside = MjvCamera {
        azimuth: 90.0,
        elevation: -10.0,
        distance: 4.0,
        ..MjvCamera::new_tracking(torso)
    };
    let bounds = |axis: usize| {
        let fold = |most: fn(f64, f64) -> f64| walls.iter().map(|wall| wall[axis]).reduce(most);
        fold(f64::min).zip(fold(f64::max))
    };
    let (Some((west, east)), Some((south, north))) = (bounds(0), bounds(1)) else { return beside };
    let center = [(west + east) / 2.0, (south + north) / 2.0];
    let [width, height] = [east - west, north - south].map(|between| between + CELL);
    let seen = (height / (1.0 - CAPTION)).max(width / aspect);
    let lookat = [center[0], center[1] + seen * CAPTION / 2.0, 0.0];
    MjvCamera {
        lookat,
        azimuth: 90.0,
        elevation: -80.0,
        distance: WHOLE * seen,
        ..MjvCamera::default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_robot_has_a_stage_and_a_maze_is_seen_from_above() {
        for spec in quad_dataset::environment::all() {
            let model = model(spec, (320, 240)).unwrap();
            assert_eq!(model.nq() as usize, spec.qpos_dim, "{}: poses fit the model", spec.name);
            let floor = model.name_to_id(MjtObjBase::mjOBJ_GEOM, "floor").unwrap();
            assert_eq!(model.geom_matid()[floor], 0, "{}: the floor is a checkerboard", spec.name);
            let camera = camera(&model, 4.0 / 3.0);
            let (above, maze) = (camera.elevation < -45.0, spec.goal.is_some());
            assert_eq!((above, camera.trackbodyid == 1), (maze, !maze), "{}", spec.name);
        }
    }
}
