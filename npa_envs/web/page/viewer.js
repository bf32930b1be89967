// The page over the engine behind a server.

import { connect } from "./engine_socket.js";
import { start } from "./page.js";

start(connect, {});
