// SPDX-License-Identifier: Apache-2.0
// The login of pages of other computers, by the link of an invitation. Its token is in the fragment, which no server logs.

import { signal } from "@preact/signals";

export type LoginProblem = "" | "login_refused" | "login_slowed" | "login_unreachable";

/** The server wants a login: the page shows nothing else. */
export const needsLogin = signal(false);
export const loginProblem = signal<LoginProblem>("");

/** The close code of a connection whose session has ended. */
export const SESSION_ENDED = 4401;

/** The token in a link or a text that a user has pasted; "" where there is none. */
export function invitationIn(text: string): string {
  return /(?:#invite=|^)([\w-]{20,100})$/.exec(text.trim())?.[1] ?? "";
}

/** Logs in by the token of the page's address, which loses it: no history or bookmark has it. Returns whether it is in. */
export async function logInByAddress(): Promise<boolean> {
  const token = location.hash.startsWith("#invite=") ? invitationIn(location.hash) : "";
  if (token === "") return false;
  history.replaceState(null, "", location.pathname);
  return logIn(token);
}

/** Logs in. Returns whether the server gave a session, which is a cookie that scripts do not see. */
export async function logIn(token: string): Promise<boolean> {
  const headers = { "Content-Type": "application/json" };
  try {
    const answer = await fetch("/login", { method: "POST", headers, body: JSON.stringify({ token }) });
    loginProblem.value = answer.ok ? "" : answer.status === 429 ? "login_slowed" : "login_refused";
    return answer.ok;
  } catch {
    loginProblem.value = "login_unreachable";
    return false;
  }
}

/** Ends the session of this browser. */
export async function logOut(csrf: string): Promise<void> {
  try {
    await fetch("/logout", { method: "POST", headers: { "X-CSRF": csrf } });
  } finally {
    location.reload(); // nothing of the robot stays on the screen
  }
}

/** Finds out whether a connection was refused for want of a login. A server that does not answer is no such refusal. */
export async function checkSession(): Promise<boolean> {
  try {
    const answer = await fetch("/session", { cache: "no-store" });
    needsLogin.value = answer.status === 401;
  } catch {
    needsLogin.value = false;
  }
  return needsLogin.value;
}
