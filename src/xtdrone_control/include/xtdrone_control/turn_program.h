// The former name of xtdrone_lockstep/turn_program.h.
#pragma once

#include "xtdrone_lockstep/turn_program.h"

namespace xtdrone_control {
using xtdrone_lockstep::Messages;
using xtdrone_lockstep::Publication;
using xtdrone_lockstep::TurnProgram;
}  // namespace xtdrone_control
