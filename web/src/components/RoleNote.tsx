// SPDX-License-Identifier: Apache-2.0
// Says in a panel why some of its buttons are off: the role of this page does not suffice.

import { hello } from "../state";
import { t } from "../texts";
import { type PanelName } from "../ui";

const OF_OPERATORS: ReadonlySet<string> = new Set<PanelName>(["task", "places", "maps", "recordings"]);
const OF_ADMINS: ReadonlySet<string> = new Set<PanelName>(["maps", "recordings"]);

export function RoleNote({ panel }: { panel: string }) {
  const role = hello.value?.role;
  if (role === "viewer" && OF_OPERATORS.has(panel)) return <p class="muted role-note">{t("viewer_note")}</p>;
  if (role === "operator" && OF_ADMINS.has(panel)) return <p class="muted role-note">{t("operator_note")}</p>;
  return null;
}
