// SPDX-License-Identifier: Apache-2.0
// What a page of another computer shows before its login: no button of the robot, for none would work.

import { useSignal } from "@preact/signals";

import { invitationIn, logIn, loginProblem } from "../access";
import { t } from "../texts";
import { Button, Field } from "./controls";

const MAX_LINK = 400; // characters

export function LoginView() {
  const text = useSignal("");
  const token = invitationIn(text.value);
  const enter = async (): Promise<void> => {
    if (await logIn(token)) location.reload();
  };
  return (
    <form
      class="offline login"
      aria-label={t("log_in")}
      onSubmit={(event) => {
        event.preventDefault();
        if (token !== "") void enter();
      }}
    >
      <p class="offline-title">{t("log_in")}</p>
      <p>{t("login_hint")}</p>
      {loginProblem.value !== "" && (
        <p class="bad-text" role="alert">
          {t(loginProblem.value)}
        </p>
      )}
      <Field label={t("login_link")}>
        <input
          type="text"
          autocomplete="off"
          maxLength={MAX_LINK}
          value={text.value}
          onInput={(event) => (text.value = event.currentTarget.value)}
        />
      </Field>
      <Button label={t("log_in")} kind="primary" onClick={() => void enter()} disabled={token === ""} />
    </form>
  );
}
