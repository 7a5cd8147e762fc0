"""What several plugins share: settings, frames, setpoint messages, tf and reasons for refusals."""
