//! OpenGL without a screen: EGL on Mesa's surfaceless platform, which needs no GPU.
//!
//! The program loads libEGL when it makes a film, not when it starts: evaluators run on machines
//! without libEGL.

use anyhow::Context;
use khronos_egl::{self as egl, DynamicInstance, EGL1_5};
use quad_runtime::Hint;

pub const INSTALL: &str =
    "apt-get install --no-install-recommends libegl1 libegl-mesa0 libgl1-mesa-dri";
/// `EGL_PLATFORM_SURFACELESS_MESA`, of the extension `EGL_MESA_platform_surfaceless`.
const SURFACELESS: egl::Enum = 0x31DD;

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
