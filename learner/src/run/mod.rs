//! TEMPORARY: the lead's room.
pub(crate) mod train;
pub(crate) mod verify;
