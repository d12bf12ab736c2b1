// SPDX-License-Identifier: Apache-2.0
import { signal } from "@preact/signals";

/** Whether the view moves with the robot. */
export const following = signal(false);
