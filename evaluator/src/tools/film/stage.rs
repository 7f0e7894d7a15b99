//! Draws poses: the model with colors, a floor and a light, seen by a camera.
//!
//! OpenGL needs no screen: EGL on Mesa's surfaceless platform, which needs no GPU. The program loads
//! libEGL when it makes a film, not when it starts: evaluators run on machines without it.

use anyhow::Context;
use khronos_egl::{self as egl, DynamicInstance, EGL1_5};
use mujoco_rs::wrappers::mj_data::MjData;
use mujoco_rs::wrappers::mj_model::{MjModel, MjtGeom, MjtGeomBase, MjtObjBase};
use mujoco_rs::wrappers::mj_rendering::{MjrContext, MjrRectangle, MjtFont, MjtGridPos};
use mujoco_rs::wrappers::mj_visualization::{
    MjtRndFlag, MjvCamera, MjvOption, MjvPerturb, MjvScene,
};
use quad_dataset::{CELL, EnvironmentSpec};
use quad_runtime::Hint;

use super::encode::{Format, Picture};
use super::episode::{FilmedEpisode, Pose};
use crate::sim::{self, EnvironmentError};

pub const INSTALL: &str =
    "apt-get install --no-install-recommends libegl1 libegl-mesa0 libgl1-mesa-dri";
/// `EGL_PLATFORM_SURFACELESS_MESA`, of the extension `EGL_MESA_platform_surfaceless`.
const SURFACELESS: egl::Enum = 0x31DD;

/// The parts of a model that only a camera sees. The light follows the robot.
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
/// Colors of a robot's first and last body, so that crossing legs differ.
const ROBOT: [[f32; 3]; 2] = [[0.93, 0.49, 0.15], [0.16, 0.38, 0.66]];
const WALL: [f32; 4] = [0.8, 0.7, 0.55, 1.0];
const GOAL: [f32; 4] = [0.85, 0.15, 0.2, 0.6];
/// Capacity of a scene for geometries beyond the model's: the goal, and those that MuJoCo adds.
const EXTRA_GEOMS: usize = 100;
/// Distance at which a free camera, whose vertical angle is 45°, sees all of an object of height 1.
const DISTANCE: f64 = 1.25;
/// The share of a view's height that the caption takes.
const CAPTION: f64 = 0.2;

/// An OpenGL context, current on the thread that made it.
pub struct Gl {
    /// The library, whose objects are valid as long as it is loaded.
    _egl: DynamicInstance<EGL1_5>,
}

impl Gl {
    pub fn new() -> anyhow::Result<Self> {
        Self::open().context("pictures need EGL with Mesa's software driver").hint(INSTALL)
    }

    fn open() -> anyhow::Result<Self> {
        // SAFETY: libEGL is the system's; loading it has no precondition.
        let egl = unsafe { DynamicInstance::<EGL1_5>::load_required() }
            .map_err(|error| anyhow::anyhow!("{error}"))?;
        // SAFETY: this platform takes no native display.
        let display = unsafe {
            egl.get_platform_display(SURFACELESS, egl::DEFAULT_DISPLAY, &[egl::ATTRIB_NONE])?
        };
        egl.initialize(display)?;
        egl.bind_api(egl::OPENGL_API)?;
        let wanted =
            [egl::SURFACE_TYPE, egl::PBUFFER_BIT, egl::RENDERABLE_TYPE, egl::OPENGL_BIT, egl::NONE];
        let config = egl.choose_first_config(display, &wanted)?;
        let config = config.context("it does not support OpenGL")?;
        let context = egl.create_context(display, config, None, &[egl::NONE])?;
        egl.make_current(display, None, None, Some(context))?;
        Ok(Self { _egl: egl })
    }
}

/// Draws the films of one environment.
pub struct Stage {
    // MuJoCo frees its OpenGL objects before `_gl` ends: fields are dropped in this order.
    context: MjrContext,
    scene: MjvScene,
    data: MjData<Box<MjModel>>,
    camera: MjvCamera,
    /// Radius of the ball at a goal, meters.
    reach: f64,
    format: Format,
    _gl: Gl,
}

impl Stage {
    /// Makes the stage of an environment, for pictures of several episodes.
    pub fn new(spec: &EnvironmentSpec, format: Format, episodes: usize) -> anyhow::Result<Self> {
        let gl = Gl::new()?;
        let model = Box::new(model(spec, format.size(episodes))?);
        let camera = camera(&model, format.aspect());
        // SAFETY: the context of `gl` is current on this thread, and outlives what is made here.
        let mut context = unsafe { MjrContext::new(&model) };
        context.offscreen();
        let mut scene = MjvScene::new(&model, model.geom_size().len() + EXTRA_GEOMS);
        // MuJoCo draws shadows only around one robot; shadows of a whole maze would be in pieces.
        scene.flags_mut()[MjtRndFlag::mjRND_SHADOW as usize] = u8::from(camera.trackbodyid >= 0);
        let data = MjData::try_new(model)
            .map_err(|error| EnvironmentError::Allocation(error.to_string()))?;
        Ok(Self {
            context,
            scene,
            data,
            camera,
            reach: spec.maze.map_or(0.0, |maze| maze.reach),
            format,
            _gl: gl,
        })
    }

    /// The picture of all episodes after `steps` steps.
    pub fn draw(&mut self, episodes: &[FilmedEpisode], steps: usize) -> anyhow::Result<Picture> {
        for (index, episode) in episodes.iter().enumerate() {
            let view = self.format.view(index, episodes.len()).map(|pixels| pixels as i32);
            let view = MjrRectangle::new(view[0], view[1], view[2], view[3]);
            self.pose(episode.pose(steps));
            self.scene.render(&view, &self.context);
            let (font, corner) = (MjtFont::mjFONT_NORMAL, MjtGridPos::mjGRID_TOPLEFT);
            let [left, right] = episode.caption(steps);
            self.context.overlay(font, corner, view, &left, Some(&right));
        }
        let (width, height) = self.format.size(episodes.len());
        let mut rgb = vec![0; width * height * 3];
        let whole = MjrRectangle::new(0, 0, width as i32, height as i32);
        self.context.read_pixels(Some(&mut rgb), None, &whole)?;
        // OpenGL's rows begin at the bottom.
        let rgb = rgb.chunks_exact(3 * width).rev().flatten().copied().collect();
        Ok(Picture { width, rgb })
    }

    fn pose(&mut self, pose: &Pose) {
        self.data.qpos_mut().copy_from_slice(&pose.qpos);
        self.data.forward();
        let (option, perturb) = (MjvOption::default(), MjvPerturb::default());
        self.scene.update(&mut self.data, &option, &perturb, &mut self.camera);
        if let Some([x, y]) = pose.goal {
            let (size, center) = ([self.reach; 3], [x, y, self.reach]);
            let (shape, color) = (MjtGeom::mjGEOM_SPHERE, Some(GOAL));
            // SAFETY: it has no material, texture or object, and the scene has capacity for it.
            unsafe { self.scene.create_geom(shape, Some(size), Some(center), None, color) };
        }
    }
}

/// The model of an environment with its looks, for pictures of a width and a height.
fn model(spec: &EnvironmentSpec, (width, height): (usize, usize)) -> anyhow::Result<MjModel> {
    let looks = LOOKS.replace("{width}", &width.to_string());
    let looks = looks.replace("{height}", &height.to_string());
    let mjcf = sim::mjcf(spec).replacen("<worldbody>", &looks, 1);
    let mjcf = mjcf.replacen(r#"<geom name="floor""#, r#"<geom name="floor" material="floor""#, 1);
    let mut model = MjModel::from_xml_string(&mjcf)?;
    paint(&mut model);
    Ok(model)
}

/// Colors the robot and the walls, and extends the floor to infinity.
fn paint(model: &mut MjModel) {
    let bodies = model.geom_bodyid().to_vec();
    let last = bodies.iter().copied().max().unwrap_or(1);
    for (geom, body) in bodies.into_iter().enumerate() {
        let share = (body - 1) as f32 / (last - 1).max(1) as f32;
        let mix = |i: usize| ROBOT[0][i] + share * (ROBOT[1][i] - ROBOT[0][i]);
        let color = if body == 0 { WALL } else { [mix(0), mix(1), mix(2), 1.0] };
        model.geom_rgba_mut()[geom] = color;
    }
    if let Some(floor) = model.name_to_id(MjtObjBase::mjOBJ_GEOM, "floor") {
        model.geom_size_mut()[floor] = [0.0, 0.0, 1.0];
        model.geom_rgba_mut()[floor] = [1.0; 4];
    }
}

/// A camera that follows the robot from the side or, in a maze, looks at all walls from above.
/// `aspect` is a view's width over its height.
fn camera(model: &MjModel, aspect: f64) -> MjvCamera {
    let walls = (0..model.geom_size().len()).filter(|&geom| {
        model.geom_bodyid()[geom] == 0 && model.geom_type()[geom] == MjtGeomBase::mjGEOM_BOX
    });
    let walls: Vec<[f64; 3]> = walls.map(|geom| model.geom_pos()[geom]).collect();
    let bounds = |axis: usize| {
        let fold = |most: fn(f64, f64) -> f64| walls.iter().map(|wall| wall[axis]).reduce(most);
        fold(f64::min).zip(fold(f64::max))
    };
    let mut camera;
    if let (Some((west, east)), Some((south, north))) = (bounds(0), bounds(1)) {
        let [width, height] = [east - west, north - south].map(|between| between + CELL);
        let seen = (height / (1.0 - CAPTION)).max(width / aspect);
        camera = MjvCamera::default();
        camera.lookat = [(west + east) / 2.0, (south + north + seen * CAPTION) / 2.0, 0.0];
        (camera.elevation, camera.distance) = (-80.0, DISTANCE * seen);
    } else {
        let torso = model.name_to_id(MjtObjBase::mjOBJ_BODY, "torso").unwrap_or(1);
        camera = MjvCamera::new_tracking(torso);
        (camera.elevation, camera.distance) = (-10.0, 4.0);
    }
    camera.azimuth = 90.0;
    camera
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_robot_has_a_stage_and_a_maze_is_seen_from_above() {
        for spec in quad_dataset::environment::specs() {
            let model = model(spec, (320, 240)).unwrap();
            let name = &spec.name;
            assert_eq!(model.nq() as usize, spec.qpos_dim, "{name}: poses fit the model");
            let floor = model.name_to_id(MjtObjBase::mjOBJ_GEOM, "floor").unwrap();
            let material = model.geom_matid()[floor];
            assert_eq!(material, 0, "{name}: the floor is a checkerboard");
            let camera = camera(&model, 4.0 / 3.0);
            let (above, maze) = (camera.elevation < -45.0, spec.maze.is_some());
            assert_eq!(above, maze, "{name}");
            assert_eq!(camera.trackbodyid == 1, !maze, "{name}");
        }
    }
}
